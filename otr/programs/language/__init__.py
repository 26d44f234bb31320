"""The language of programs: text to tokens, tokens to syntax, syntax to the tests and leaves of a tree."""
