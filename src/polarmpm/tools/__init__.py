"""What everything else may use: versions of libraries, ranks, checks of arguments, timing."""
