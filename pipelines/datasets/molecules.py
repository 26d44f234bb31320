"""LCN's split files: a fingerprint of 2,048 characters 0 and 1 a line, then the labels, empty where not measured."""

import csv

import numpy as np

N_BITS = 2048
FEATURE_NAMES = tuple(f"bit{bit}" for bit in range(N_BITS))


def parse_split(content: bytes) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Return label names, features (n, 2048), uint8, and labels (n, n_labels), NaN where empty, of a split file.

    The header's names may be quoted (SIDER's have commas in them); lines end with LF.

    Raises:
        ValueError: the content has another form; says in which line.
    """
    characters = np.frombuffer(content, dtype=np.uint8)
    ends = np.flatnonzero(characters == ord("\n"))
    if len(ends) == 0 or ends[-1] != len(content) - 1:
        raise ValueError("the last line does not end")
    (header,) = csv.reader([content[: ends[0]].decode()])
    names = tuple(header[1:])
    starts, ends = ends[:-1] + 1, ends[1:]
    labels = _label_texts(content, starts, ends, len(names))
    if not labels:
        return names, np.empty((0, N_BITS), np.uint8), np.empty((0, len(names)))
    X = np.lib.stride_tricks.sliding_window_view(characters, N_BITS)[starts]  # copies whole rows: (n, 2048)
    X -= ord("0")
    wrong = np.flatnonzero(X.max(axis=1) > 1)
    if len(wrong):
        raise ValueError(f"line {wrong[0] + 2}: the fingerprint is not made of 0 and 1 alone")
    try:
        Y = np.array([[float(text) if text else np.nan for text in row] for row in labels])
    except ValueError as error:
        raise ValueError(f"a label is no number: {error}") from error
    return names, X, Y


def _label_texts(content: bytes, starts: np.ndarray, ends: np.ndarray, n_labels: int) -> list[list[bytes]]:
    """Return the labels of each line as text."""
    labels = []
    for line, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True), start=2):
        if content[start + N_BITS : start + N_BITS + 1] != b"," or end <= start + N_BITS:
            raise ValueError(f"line {line}: {N_BITS} characters and a comma were expected")
        texts = content[start + N_BITS + 1 : end].split(b",")
        if len(texts) != n_labels:
            raise ValueError(f"line {line}: {len(texts)} labels where the header has {n_labels}")
        labels.append(texts)
    return labels
