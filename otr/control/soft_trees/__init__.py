"""Soft trees, which learn by gradient and harden into trees, and policies as modules of torch."""
