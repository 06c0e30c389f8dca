"""What a script talks to: quasi-static problems of material points and of finite elements."""
