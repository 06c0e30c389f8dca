"""From UFL to machine code, and the compiled loops over points; nothing of mechanics."""
