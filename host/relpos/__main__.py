"""``python -m relpos``: the command line."""

from relpos.cli.start import run

if __name__ == "__main__":
    run()
