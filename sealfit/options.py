"""Arguments and options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

Campaign = Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="Campaign folder: runs.csv and the trace files.")]
Results = Annotated[Path, typer.Argument(metavar="OUT", help="Folder of results that `ingest` or `run` made.")]
Out = Annotated[Path, typer.Option("--out", help="Folder of results; made if it is not there.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="Rig config (TOML); default: as the README's table.")]
Workers = Annotated[int | None, typer.Option("--workers", min=1, help="Processes to use. [default: all cores]")]
Scheduler = Annotated[
    str | None,
    typer.Option("--scheduler", metavar="ADDRESS", help="Dask scheduler to work on: tcp://host:port, or its file."),
]
Force = Annotated[bool, typer.Option("--force", help="Do it again even if it is current.")]
Strict = Annotated[bool, typer.Option("--strict", help="Stop with exit code 1 at any fault of the campaign.")]
Profile = Annotated[bool, typer.Option("--profile", help="Print seconds and rows per step.")]
EffectsFolder = Annotated[
    Path | None,
    typer.Option("--effects-folder", metavar="FOLDER", help="Folder of your own effects. Python is run from it."),
]
Json = Annotated[bool, typer.Option("--json", help="Print exactly one JSON object on stdout.")]
