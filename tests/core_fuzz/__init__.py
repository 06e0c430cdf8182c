"""The native core of each room with sanitizers and asserts, under drawn worlds and misuse."""
