"""The commands, a module each; `pipelines/cli/main.py` calls its function `do`."""
