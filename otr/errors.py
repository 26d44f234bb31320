"""Errors that the library raises; each message says what was wrong, where, and what to do."""

__all__ = [
    "ArtefactError",
    "CertificateError",
    "InvalidNetworkError",
    "InvalidTreeError",
    "OtrError",
    "TreeTooLargeError",
]


class OtrError(Exception):
    """Base of every error that is particular to this library."""


class InvalidNetworkError(OtrError, ValueError):
    """A network's shapes or numbers make no sense, or it is of a kind that cannot be imported."""


class InvalidTreeError(OtrError, ValueError):
    """A tree's arrays break an invariant of `ObliqueTree`."""


class TreeTooLargeError(OtrError):
    """The tree asked for has more leaves than the caller allows."""


class CertificateError(OtrError):
    """A tree and a network are not the same function, or a certificate does not prove that they are."""


class ArtefactError(OtrError):
    """A file is missing, truncated, changed since it was written, or of another schema."""
