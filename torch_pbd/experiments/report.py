"""The report of a run: one self-contained page of its tables and figures, what each means, and how to go on."""

import base64
import html
from collections.abc import Iterable
from pathlib import Path

from torch_pbd.experiments.run_folder import RunFolder

_CAPTIONS = {
    "tunnel": "Demonstrations (grey), and mean and two standard deviations of each model along the path: a model is "
    "good where its ellipses are as wide as the demonstrations differ, and no wider.",
    "figure5": "How the parts are connected.",
    "figure6": "The path that the controller reproduces, and how far demonstrations differ from it.",
    "figure7": "Above, standard deviations along the movement, of the demonstrations and as learned; below, the "
    "stiffness made of them: where one is small the other is large.",
    "figure8": "The same push twice, early and late: the robot gives way where demonstrations differed.",
    "recordings": "The recordings, output by output.",
    "figure": "What the model learned, over the data.",
}
"""What a figure shows, by the part of its name; the last is of all others."""

_STYLE = """
:root { color-scheme: light dark; --line: #8886; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
pre { font: 13px/1.4 ui-monospace, monospace; overflow-x: auto; border-left: 3px solid var(--line); padding-left: 1em }
figure { margin: 2rem 0; } figcaption { margin-top: .4rem; }
img { max-width: 100%; height: auto; background: white; }
"""


def write_report(folder: RunFolder, command: str, text: str) -> Path:
    """Write ``index.html``: the text of a run, its figures inside, and commands that go on from its files.

    Nothing in it is read from elsewhere, so that the page can be sent by itself.
    """
    parts = [f"<h1>torch-pbd {html.escape(command)}</h1>", f"<pre>{html.escape(text)}</pre>"]
    for path in folder.figures:
        data = base64.b64encode(path.read_bytes()).decode()
        caption = html.escape(f"{path.stem}: {_caption(path.stem)}")
        picture = f'<img alt="{caption}" src="data:image/png;base64,{data}">'
        parts.append(f"<figure>{picture}<figcaption>{caption}</figcaption></figure>")
    lines = html.escape("\n".join(_next_steps(folder.path, command)))
    parts.append(f"<h2>To go on</h2><pre>{lines}</pre>")
    head = f'<meta charset="utf-8"><title>torch-pbd {html.escape(command)}</title><style>{_STYLE}</style>'
    body = "\n".join(parts)
    folder.write_text("index.html", f'<!doctype html><html lang="en"><head>{head}</head><body>{body}</body></html>\n')
    return folder.path / "index.html"


def _caption(name: str) -> str:
    return next(text for part, text in _CAPTIONS.items() if part in name or part == "figure")


def _next_steps(folder: Path, command: str) -> Iterable[str]:
    """Commands and lines of Python for the files that a run has left."""
    if (folder / "demonstrations.csv").is_file():
        yield f"torch-pbd compare --data {folder / 'demonstrations.csv'}"
        yield f"torch-pbd experiment --data {folder / 'demonstrations.csv'}"
    yield f"torch-pbd {command} --config {folder / 'config.yaml'}  # the same again"
    models, schedules = sorted((folder / "model").glob("*.safetensors")), sorted((folder / "schedule").glob("*.npz"))
    if models or schedules:
        yield "python"
    for path in models:
        yield f">>> torch_pbd.load({str(path)!r})"
    for path in schedules:
        yield f">>> torch_pbd.control.Schedule.load({str(path)!r})"
