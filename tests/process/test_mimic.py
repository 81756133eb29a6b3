"""A drawing for the operator's page, from a process file to the model file."""

import gzip
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import pytest

from coldloop.errors import ColdloopError
from coldloop_rig.process_file.reading import drawing_of

SIGNALS: Final = ("h1", "v1", "load")
TEXTS: Final = ("text", "tspan")
HEAD: Final = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 10 10"'


def drawn(folder: Path, inside: str, head: str = HEAD) -> str:
    """Return what becomes of a drawing with something in it."""
    file = folder / "drawing.svg"
    file.write_text(f"{head}>{inside}</svg>", encoding="utf-8")
    return drawing_of(file, SIGNALS)


def test_a_text_with_the_name_of_a_signal_shows_it(tmp_path: Path) -> None:
    """As any editor writes it; also in a part of a text."""
    found = ET.fromstring(drawn(tmp_path, "<text> {h1} </text><text>inflow <tspan>{v1}</tspan></text>"))  # noqa: S314
    texts, parts = ([(one.get("data-signal"), one.text) for one in found.findall(f".//{{*}}{tag}")] for tag in TEXTS)
    assert texts == [("h1", None), (None, "inflow ")]
    assert parts == [("v1", None)]


def test_a_name_within_a_text_shows_its_signal_there(tmp_path: Path) -> None:
    text = drawn(tmp_path, "<text>level {h1}, pump {v1} V<tspan>now</tspan> {load}</text>")
    parts = ["level ", "h1", ", pump ", "v1", " V", "now", " ", "load"]
    (found,) = ET.fromstring(text)  # noqa: S314
    shown = [found.text]
    for one in found:
        shown += [one.get("data-signal") or one.text, one.tail]
    assert [each for each in shown if each] == parts


def test_a_drawing_that_is_compressed_is_refused_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "drawing.svgz").write_bytes(gzip.compress(b"<svg/>"))
    with pytest.raises(ColdloopError, match=r"not UTF-8 text .* not compressed"):
        drawing_of(tmp_path / "drawing.svgz", SIGNALS)


@pytest.mark.parametrize("reference", ["url(#g)", "url('#g')", "URL( #g )"])
def test_a_reference_is_to_the_name_that_it_has_on_the_page(reference: str, tmp_path: Path) -> None:
    text = drawn(tmp_path, f'<linearGradient id="g"/><rect fill="{reference}" data-page="of an editor"/>')
    assert 'fill="url(#mimic-g)"' in text
    assert "data-page" not in text


def test_what_an_editor_adds_is_left_out_and_style_becomes_attributes(tmp_path: Path) -> None:
    head = HEAD + ' xmlns:ed="http://editor.example/ns" width="10mm" ed:version="1"'
    inside = (
        '<ed:view zoom="2"/><metadata>me</metadata>'
        '<linearGradient id="g"/><rect ed:label="a" style="fill:url(#g); stroke: #123456" id="view"/>'
        '<use href="#view"/>'
    )
    text = drawn(tmp_path, inside, head)
    assert "editor.example" not in text
    assert "metadata" not in text
    assert "10mm" not in text
    assert 'fill="url(#mimic-g)"' in text
    assert 'stroke="#123456"' in text
    assert 'id="mimic-view"' in text, "the page has an element of this name"
    assert 'href="#mimic-view"' in text


USE: Final = "<use href='#a?'/>"
REFUSED: Final = {
    "<script>alert(1)</script>": "<script> has no place in a drawing",
    "<foreignObject/>": "<foreignObject> has no place",
    "<image href='data:image/png;base64,AA'/>": "<image> has no place",
    "<style>text { fill: red }</style>": "<style> has no place",
    "<rect onclick='alert(1)'/>": 'onclick="alert(1)" reaches outside',
    "<rect ONLOAD='alert(1)'/>": "reaches outside",
    "<use href='https://elsewhere.example/a.svg#b'/>": "reaches outside",
    "<use xmlns:l='http://www.w3.org/1999/xlink' l:href='javascript:alert(1)'/>": "reaches outside",
    "<rect fill='url(https://elsewhere.example/a)'/>": "reaches outside",
    "<rect style='fill: url(//elsewhere.example/a)'/>": "reaches outside",
    "<rect fill='URL(https://elsewhere.example/a)'/>": "reaches outside",
    r"<rect fill='\75 rl(https://elsewhere.example/a)'/>": "reaches outside",
    "<rect mask='image-set(\"https://elsewhere.example/a\" 1x)'/>": "reaches outside",
    "<text>{T5}</text>": "T5 is no signal of this process: h1, v1, load",
    "<text>level {T5} cm</text>": "T5 is no signal of this process",
    "<g data-signal='h1'><rect/></g>": '<g data-signal="h1">: a value is shown by a text',
    "<circle data-fill='h1'/>": '<circle data-fill="h1">: what is filled is a rect',
    "<rect height='50%' data-fill='h1'/>": "y and height in plain numbers",
    "<rect height='5' data-fill='h1' data-low='empty'/>": "data-low and data-high are two different numbers",
    "<rect height='5' data-fill='h1' data-low='1' data-high='1'/>": "data-low and data-high are two different numbers",
    101 * "<g>" + 101 * "</g>": "more than 100 levels",
    "<g id='a'><use href='#a'/></g>": "more than 100 levels",
    "<g id='a0'/>"
    + "".join(f"<g id='a{k}'>{10 * USE}</g>".replace("?", f"{k - 1}") for k in range(1, 7)): "more than 50000",
    "<pattern id='p0'/>"
    + "".join(
        f"<pattern id='p{k}'>{10 * '<rect #>'}</pattern>".replace("#", f"{how}='url(#p{k - 1})'/")
        for k, how in enumerate(("fill", "mask", "style='x:y' clip-path", "marker-end", "stroke", "filter"), start=1)
    ): "more than 50000",
    "<g id='q0'/>"
    + "".join(
        f"<g fill='url(#q{k - 1})'><pattern id='q{k}'>{10 * '<rect/>'}</pattern></g>" for k in range(1, 7)
    ): "more than 50000",
    "<pattern id='p'><rect style='fill: url(#p)'/></pattern>": "more than 100 levels",
    "<rect height='5' data-fill='h1' data-low='nan' data-high='1'/>": "data-low and data-high are two",
    "<rect data-fill='T5'/>": "T5 is no signal",
    "<rect>": "not an SVG file: mismatched tag",
}


@pytest.mark.parametrize("inside", REFUSED)
def test_what_would_act_or_is_unknown_is_refused_in_one_line(inside: str, tmp_path: Path) -> None:
    with pytest.raises(ColdloopError) as refused:
        drawn(tmp_path, inside)
    assert REFUSED[inside] in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("<svg xmlns='http://www.w3.org/2000/svg'/>", "no viewBox"),
        ("<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 wide high'/>", "no viewBox of 4 numbers"),
        ("<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 nan 5'/>", "no viewBox of 4 numbers"),
        ("<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 5 inf'/>", "no viewBox of 4 numbers"),
        ("<html/>", "it begins with html"),
        ("<!DOCTYPE svg [<!ENTITY a 'b'>]><svg xmlns='http://www.w3.org/2000/svg'>&a;</svg>", "declares entities"),
        ("<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 1 1'>" + 500_000 * " " + "</svg>", "500000 at most"),
    ],
)
def test_a_file_that_is_no_drawing_is_refused(text: str, why: str, tmp_path: Path) -> None:
    (tmp_path / "drawing.svg").write_text(text, encoding="utf-8")
    with pytest.raises(ColdloopError, match=why):
        drawing_of(tmp_path / "drawing.svg", SIGNALS)
    with pytest.raises(ColdloopError, match="mimic names an SVG file"):
        drawing_of(tmp_path / "absent.svg", SIGNALS)
