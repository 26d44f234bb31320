"""Shorter programs: numbers dropped and rounded, tests taken out or refitted, within a measured or proved bound."""
