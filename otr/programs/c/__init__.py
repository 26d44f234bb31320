"""A tree or network as one C99 source file."""
