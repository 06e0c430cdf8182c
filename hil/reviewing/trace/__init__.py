"""The bus decoded: frames of any log in, what they say in words and SI units out."""
