"""What the renderings promise: self-contained, escaped, the same every time, plain types, readable widths."""

from __future__ import annotations

import csv
import io
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from report_data import at, campaign, failed, measurement, review, warehouse

from warehouse.render import Format, render
from warehouse.report import REPORTS, Report, accuracy_from_pairs, build
from wheelset_assets.quality import ConfigError

HOSTILE = '"><script>alert(1)</script>|*x*`&{{7*7}}$y$'
VOID = {"meta", "link", "br", "hr", "img", "input", "col"}


class Page(HTMLParser):
    """Collects tags, text and identifiers, and sees that tags nest."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.identifiers: list[str] = []
        self.links: list[str] = []
        self.words = ""
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.tags.append(tag)
        self.identifiers += [given["id"] or ""] if "id" in given else []
        self.links += [given["href"] or ""] if "href" in given else []
        assert not [name for name in given if name.startswith("on")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += data


@pytest.fixture(scope="module", params=list(REPORTS))
def report(request: pytest.FixtureRequest) -> Report:
    return build(campaign(), request.param, {})


@pytest.fixture(scope="module")
def page(report: Report) -> str:
    html = render(report, "html")
    assert isinstance(html, str)
    return html


def hostile(name: str) -> Report:
    values = [
        measurement(HOSTILE, quantity, side, size + i / 1000, wheelset_id=HOSTILE, captured_at=at(4 + i, 1))
        for i in range(3)
        for quantity, side, size in (("wheel_diameter", "left", 920.0), (HOSTILE, "right", 1.0))
    ]
    reviews = [review(quantity, side, 920.0, at(4, 1), wheelset_id=HOSTILE, instrument=HOSTILE)
               for quantity, side in (("wheel_diameter", "left"), (HOSTILE, "right"))]  # fmt: skip
    connection = warehouse(values, reviews, [failed(HOSTILE, at(4, 1), f"{HOSTILE}\n\x1b[31msecond line")])
    return build(connection, name, {"wheelset_id": HOSTILE})


def hostile_formula() -> Report:
    return build(warehouse([measurement("=1+1", "wheel_diameter", "left", 920.0)]), "stability", {})


def test_every_column_of_every_block_has_its_meaning(report: Report) -> None:
    for block in report.blocks.values():
        assert list(block.query.meanings) == block.table.column_names, block.query.file
        assert block.query.answers
        assert set(block.spec.shown) <= set(block.table.column_names)


def test_the_page_stands_alone(page: str) -> None:
    parsed = Page(page)
    assert "://" not in page
    assert not {"script", "link", "img", "iframe", "object", "form"} & set(parsed.tags)
    assert not re.search(r"@import|@font-face|url\((?!#)", page)
    assert "svg" in parsed.tags
    assert len(set(parsed.identifiers)) == len(parsed.identifiers)
    assert {link.removeprefix("#") for link in parsed.links} <= set(parsed.identifiers)


def test_the_page_shows_every_query(report: Report, page: str) -> None:
    words = Page(page).words
    for block in report.blocks.values():
        assert block.query.text.strip() in words
        assert block.query.file in words


@pytest.mark.parametrize("name", list(REPORTS))
def test_what_comes_from_data_is_inert(name: str) -> None:
    report = hostile(name)
    html = render(report, "html")
    assert isinstance(html, str)
    assert "<script" not in html
    assert HOSTILE in Page(html).words
    markdown = render(report, "md")
    assert isinstance(markdown, str)
    assert "<script" not in markdown
    for line in markdown.splitlines():
        if line.startswith("|"):
            assert line.endswith("|")
    assert HOSTILE in json.loads(render(report, "json"))["parameters"].values()
    assert "\x1b" not in str(render(report, "table", width=80)) + html + markdown


@pytest.mark.parametrize("format", ["html", "table", "json", "md", "csv", "xlsx", "parquet"])
def test_the_same_tables_give_the_same_bytes(report: Report, page: str, format: Format) -> None:
    again = render(build(campaign(), report.spec.name, {}), format)
    assert again == (page if format == "html" else render(report, format))


def test_the_time_of_making_is_printed_only_if_given() -> None:
    stamped = render(build(warehouse(), "accuracy", {"generated_at": "2024-09-01T06:00Z"}), "html")
    assert "generated at: 2024-09-01T06:00Z" in str(stamped)


def test_json_holds_plain_types_all_rows_and_no_nan(report: Report) -> None:
    def no_constant(name: str) -> Any:
        raise AssertionError(name)

    document = json.loads(render(report, "json"), parse_constant=no_constant)
    assert {"report", "title", "parameters", "blocks"} <= set(document)
    assert list(document["blocks"]) == list(report.spec.order)
    main = document["blocks"][report.spec.main]
    assert len(main["rows"]) == report.blocks[report.spec.main].table.num_rows > 0
    assert [column["name"] for column in main["columns"]] == list(main["rows"][0])
    assert all(column["meaning"] for block in document["blocks"].values() for column in block["columns"])
    assert main["sql"].endswith(".sql")
    if report.spec.main in ("pairs", "stability"):
        assert main["rows"][0]["captured_at"] == "2024-04-12T08:00:00+00:00"


@pytest.mark.parametrize("width", [60, 80, 100, 160])
def test_terminal_tables_fit_and_do_not_fold_numbers(report: Report, width: int) -> None:
    shown = render(report, "table", width=width)
    assert isinstance(shown, str)
    assert max(len(line) for line in shown.splitlines()) <= width
    assert ("left_journal" if report.spec.name == "calibration" else "journal_diameter") in shown
    if report.spec.name not in ("msa", "calibration"):  # which tell of scatter, not of sizes
        assert re.search(r"\b920\.65\d\d\b", shown)
    assert "\x1b" not in shown


def test_an_empty_warehouse_is_said_to_be_empty() -> None:
    for name, spec in REPORTS.items():
        report = build(warehouse(), name, {})
        for format in ("table", "md", "html"):
            words = str(render(report, format, width=200))
            assert spec.nothing in words
        document = json.loads(render(report, "json"))
        assert document["notes"] == [spec.nothing]
        assert all(block["rows"] == [] for block in document["blocks"].values() if block["sql"] != "fleet/limits.sql")
        assert str(render(report, "csv")).count("\n") == 1
        assert "svg" not in Page(str(render(report, "html"))).tags


def test_long_tables_are_cut_for_people_only(report: Report, page: str) -> None:
    block = max(report.blocks.values(), key=lambda block: block.table.num_rows - block.spec.limit)
    left_out = block.table.num_rows - block.spec.limit
    assert (f"{left_out} rows between" in page) == (left_out > 0)
    assert left_out > 0 or report.spec.name == "wheelset"
    assert (
        len(list(csv.reader(io.StringIO(str(render(report, "csv", block=block.spec.name))))))
        == 1 + block.table.num_rows
    )


def test_files_and_folders(report: Report, tmp_path: Path) -> None:
    content = render(report, "parquet", tmp_path / "new" / "values.parquet")
    assert (tmp_path / "new" / "values.parquet").read_bytes() == content
    assert pq.read_table(tmp_path / "new" / "values.parquet").num_rows == report.blocks[report.spec.main].table.num_rows
    listed = str(render(report, "csv", tmp_path / "folder")).split()
    assert sorted(Path(path).name for path in listed) == sorted(
        f"{report.spec.name}_{name}.csv" for name in report.blocks
    )
    assert not list(tmp_path.rglob(".*"))
    if "refused" in report.blocks:
        assert "W9-01" in str(render(report, "csv", block="refused"))


def test_a_workbook_holds_every_block_and_no_formula(report: Report) -> None:
    from openpyxl import load_workbook

    content = render(report, "xlsx")
    assert isinstance(content, bytes)
    book = load_workbook(io.BytesIO(content))
    assert book.sheetnames == ["about", *report.blocks]
    for name, block in report.blocks.items():
        assert book[name].max_row == 1 + block.table.num_rows
        assert [cell.value for cell in book[name][1]] == block.table.column_names
    first = report.blocks[report.spec.main].table.to_pylist()[0]
    shown = {cell.value: book[report.spec.main].cell(2, cell.column).value for cell in book[report.spec.main][1]}
    for column, value in first.items():
        if isinstance(value, float):
            assert shown[column] == pytest.approx(value, rel=1e-12), column
    hostile_book = load_workbook(io.BytesIO(render(hostile_formula(), "xlsx")))  # type: ignore[arg-type]
    cells = [cell for sheet in hostile_book for row in sheet.iter_rows() for cell in row]
    assert "=1+1" in [cell.value for cell in cells]
    assert not [cell for cell in cells if cell.data_type == "f"]


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    report = build(warehouse(), "accuracy", {})
    with pytest.raises(ConfigError, match="unknown format"):
        render(report, "pdf")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="no block 'x'"):
        render(report, "csv", block="x")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        render(report, "json", tmp_path / "file" / "report.json")


def test_pairs_from_a_file_make_a_page(tmp_path: Path) -> None:
    report = accuracy_from_pairs(Path(__file__).parents[2] / "docs" / "paper-table-1.csv")
    html = str(render(report, "html", tmp_path / "page.html"))
    assert "25.00" in Page(html).words
    assert Page(html).tags.count("figure") == 10


def test_many_points_are_drawn_as_pixels_within_the_page() -> None:
    values = [
        measurement(f"s{i}", "wheel_diameter", "left", 920 + i % 7 / 1e4, captured_at=at(4, 1 + i % 28))
        for i in range(1500)
    ]
    report = build(warehouse(values, [review("wheel_diameter", "left", 920.0, at(4, 1))]), "accuracy", {})
    html = str(render(report, "html"))
    assert len(html) < 600_000
    assert "://" not in html


def test_drawing_libraries_are_loaded_only_when_drawing() -> None:
    code = (
        "import sys, warehouse.report, warehouse.render, warehouse.render_page, warehouse.render_terminal\n"
        "late = [name for name in ('matplotlib', 'jinja2', 'rich', 'scipy') if name in sys.modules]\n"
        "print(late)"
    )
    root = Path(__file__).parents[2]
    found = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
