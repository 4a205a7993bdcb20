"""A session while it runs: bytes in, pictures out, to whoever shows, keeps or sends them on."""
