"""The report of a run is one page that reads nothing from elsewhere."""

import base64
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure

from torch_pbd.experiments.run_folder import RunFolder, write_report


class Page(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.tags, self.images, self.text = [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        assert not {"href", "srcset"} & {name for name, _ in attrs}
        self.images += [value for name, value in attrs if name == "src"]

    def handle_data(self, data):
        self.text += data


@pytest.fixture
def folder(tmp_path):
    with RunFolder(tmp_path / "run", {"command": "demo"}) as folder:
        yield folder


def test_it_has_the_text_and_every_figure_of_the_run_and_no_other(folder):
    figure = Figure()
    figure.subplots().plot(np.arange(3))
    (folder.path / "figures").mkdir()
    (folder.path / "figures" / "of_another_run.png").write_bytes(b"old")
    paths = [folder.write_figure(figure, name) for name in ("tunnel", "hgp_figure8_pushes")]
    path = write_report(folder, "demo", "model  fit\n<script>alert(1)</script> & so on")
    page = Page(path.read_text(encoding="utf-8"))
    assert "script" not in page.tags
    assert "<script>alert(1)</script> & so on" in page.text
    shown = [base64.b64decode(image.removeprefix("data:image/png;base64,")) for image in page.images]
    assert shown == [each.read_bytes() for each in paths]
    assert "The same push twice" in page.text
    assert not re.search(r"https?:|url\(|@import", path.read_text(encoding="utf-8"))


def test_it_says_how_to_go_on_from_the_files_that_are_there(folder):
    (folder.path / "demonstrations.csv").write_text("demo,time,x\n")
    (folder.path / "model").mkdir()
    (folder.path / "model" / "hgp.safetensors").write_bytes(b"")
    text = Page(write_report(folder, "demo", "").read_text(encoding="utf-8")).text
    assert f"torch-pbd compare --data {folder.path / 'demonstrations.csv'}" in text
    assert f"torch_pbd.load({str(folder.path / 'model' / 'hgp.safetensors')!r})" in text
    assert "Schedule.load" not in text
