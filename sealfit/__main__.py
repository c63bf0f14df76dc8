"""python -m sealfit."""

from sealfit.cli import main

if __name__ == "__main__":
    main()
