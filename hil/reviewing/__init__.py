"""Figures of a run from its rows, in bounded memory."""
