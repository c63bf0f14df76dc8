"""Random campaigns of an independent simulator: sealfit is run on them, its results compared with the truth.

    python benchmarks/worlds.py --out FILE [--count 100] [--size small|any] [--jobs 1] [--workers 1]
                                [--minutes 60]
    python benchmarks/worlds.py --summary FILE
    python benchmarks/worlds.py --show INDEX [--seed-text TEXT] --keep DIR

Worlds are seeded by the newest commit's hash, so that none is tuned on twice; `--seed-text` takes another
text, to draw a world again. Each world's result is a line of FILE (JSON) as soon as it is there; what FILE
holds is not run again. The summary is Markdown. `--python` names the interpreter in which the sealfit to be
tried is installed.
"""

from worlds.main import main

if __name__ == "__main__":
    raise SystemExit(main(description=__doc__))
