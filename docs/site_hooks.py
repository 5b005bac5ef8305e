"""Makes a site of the pages in ``docs/``: files beside it, the reference, notebooks, a report, formulas as MathML.

The pages in ``docs/`` are written to be read in the repository too, where links lead to files that are no pages of the
site: such a link becomes its words. Forms of files are pages as they are; message codes are read from the source.
"""

import csv
import html
import json
import re
from pathlib import Path

import message_codes  # beside this file
import nbformat
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[1]
BESIDE = {
    "conventions.md": "CONVENTIONS.md",
    "benchmarks.md": "benchmarks/README.md",
    "changes.md": "CHANGELOG.md",
}
FORMS = {
    "flight-keys.md": ("flight.toml", "postflight/intake/templates/flight.toml"),
    "vehicle-keys.md": ("a vehicle file", "postflight/intake/templates/vehicle.toml"),
}
DEMO = ("irve2_reference", 0)  # scenario and seed of `postflight demo`
INTERFACE = "interface.md"
CASES = "docs/wrong_inputs.csv"
MADE = {source: page for page, source in BESIDE.items()} | {source: page for page, (_, source) in FORMS.items()}
MADE |= {CASES: "wrong-input-cases.md", "docs/message_codes.py": "message-codes.md"}
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def with_docstrings(markdown):
    """The page of the public interface: a line ``Names: `a`, `b`.`` becomes the docstrings of these names."""
    import postflight
    from postflight import plots

    def entry(name):
        return f"::: {postflight._DOOR[name]}.{name}\n"

    def described(match):
        return "\n".join(entry(name) for name in re.findall(r"`(\w+)`", match[1]) if name != "plots")

    figures = [f"::: postflight.plots.{plots._MODULE[name]}.{name}\n" for name in plots.__all__]
    text = re.sub(r"^Names: (.*)$", described, markdown, flags=re.MULTILINE)
    return "\n".join([text, "## Every figure\n", plots.__doc__, "", *figures])


def notebook(name):
    """A notebook's page and its pictures: as run by ``make docs``, else as it is stored, without output."""
    run = ROOT / "build/notebooks" / f"{name}.ipynb"
    path = run if run.exists() else ROOT / "notebooks" / f"{name}.ipynb"
    exporter = MarkdownExporter()
    resources = {"output_files_dir": f"{name}_files"}
    text, made = exporter.from_notebook_node(nbformat.read(path, as_version=4), resources)
    if not run.exists():
        text = f"*Without output; `make docs` runs it.*\n\n{text}"
    return {f"{name}.md": text, **made["outputs"]}


def sample_report():
    """Page with the report of the demo's own flight, without a changed assumption, and the report itself."""
    from postflight.runs import find_run

    words = "# A sample report\n\nThe report of [the demo](tutorial-demo.md)'s flight, which is synthetic"
    demo = ROOT / "demo-flight"
    if not (demo / "demo.png").exists():
        return {"sample-report.md": f"{words}. Not made here: `make docs` makes it.\n"}
    flown = json.loads((demo / "truth/run.json").read_text(encoding="utf-8"))
    if (flown["scenario"], flown["seed"]) != DEMO:
        raise PluginError(f"demo-flight is {flown['scenario']}, seed {flown['seed']}, and not the demo: remove it")
    style = "width: 100%; height: 80vh; border: 1px solid"
    frame = f'<iframe src="demo-report.html" title="report of the demo" style="{style}"></iframe>'
    text = f'{words}: <a href="demo-report.html">on a page of its own</a>, or here.\n\n{frame}\n'
    return {"sample-report.md": text, "demo-report.html": (find_run(demo, "plain") / "report.html").read_bytes()}


def table(path):
    """A CSV file as a table."""
    head, *rows = csv.reader(path.read_text(encoding="utf-8").splitlines())
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


def on_files(files, config):
    """Add pages that are made: of files beside ``docs/``, forms, codes, docstrings, notebooks, a report, decisions."""
    for page, source in BESIDE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    for page, (what, source) in FORMS.items():
        content = f"# Every key of {what}\n\n```toml\n{(ROOT / source).read_text(encoding='utf-8')}```\n"
        files.append(File.generated(config, page, content=content))
    files.append(File.generated(config, "message-codes.md", content=message_codes.page()))
    files.append(File.generated(config, MADE[CASES], content=f"# Cases of wrong inputs\n\n{table(ROOT / CASES)}\n"))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for name, content in notebook(path.stem).items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    for name, content in sample_report().items():
        files.append(File.generated(config, name, content=content))
    decisions = sorted((ROOT / "docs/decisions").glob("0*.md"))
    listed = "\n".join(f"- [{path.read_text().splitlines()[0].lstrip('# ')}]({path.name})" for path in decisions)
    files.append(File.generated(config, "decisions/index.md", content=f"# Decisions\n\n{listed}\n"))
    return files


def on_page_markdown(markdown, page, config, files):
    """Links that leave the pages become what they lead to within the site, or their words alone."""
    if page.file.src_uri == INTERFACE:
        markdown = with_docstrings(markdown)
    home = Path(BESIDE.get(page.file.src_uri, f"docs/{page.file.src_uri}")).parent

    def lead(match):
        words, target = match[1], match[2]
        if re.match(r"[a-z]+:|#", target):
            return match[0]
        path, _, anchor = target.partition("#")
        there = (ROOT / home / path).resolve().relative_to(ROOT).as_posix()
        made = MADE.get(there, there.removeprefix("docs/"))
        if files.get_file_from_path(made) is None:
            return words
        up = "../" * page.file.src_uri.count("/")
        return f"[{words}]({up}{made}{'#' + anchor if anchor else ''})"

    return re.sub(r"(?<!!)\[([^\[\]]*)\]\(([^)\s]+)\)", lead, markdown)


def on_page_content(content, **_):
    """Formulas in MathML: every browser draws it, and nothing has to be loaded."""

    def mathml(match):
        return convert(html.unescape(match[3]), display="block" if match[2] == "[" else "inline")

    return FORMULA.sub(mathml, content)
