"""`python -m outlap` is `outlap`."""

from outlap.cli.main import run

if __name__ == "__main__":
    run()
