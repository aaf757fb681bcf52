"""`python -m penumbra` is the command line."""

from penumbra.cli.main import main

if __name__ == "__main__":
    main()
