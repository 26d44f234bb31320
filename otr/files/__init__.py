"""Trees and networks on disk; reading members of zip files within limits."""
