"""The radio link: serial bytes to measurements."""
