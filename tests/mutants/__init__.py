"""Files that were sound once: whatever has become of one, its loader soon gives what it holds, or says bad
input."""
