"""The native core with sanitizers and asserts, under drawn frames, drives, plans and misuse."""
