"""Why a tree answers as it does: at one state, and over many."""
