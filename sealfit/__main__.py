"""The program `sealfit`, also as `python -m sealfit`."""

import sys

INTERRUPTED = 130  # 128 + SIGINT, as shells report it


def main() -> None:
    """Run the command line; Ctrl-C ends it with one line while it is still loading, too."""
    try:
        from sealfit import cli
    except KeyboardInterrupt:
        print("sealfit: interrupted; nothing was begun.", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except (MemoryError, ImportError) as error:
        from sealfit.errors import MEMORY, MORE_MEMORY, memory_ran_out

        if not memory_ran_out(error):
            raise
        print(f"sealfit: {MEMORY} {MORE_MEMORY}", file=sys.stderr)
        sys.exit(1)
    sys.exit(cli.exit_code(cli.app))


if __name__ == "__main__":
    main()
