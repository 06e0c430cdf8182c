"""Proofs in controllers' files, checked with every rounding enclosed; nothing else of servobench is used."""
