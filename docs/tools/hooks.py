"""What MkDocs does beside its own work: pages made from the program, formulas, citations.

Markers in the pages are replaced: `<!-- commands -->` by the help of every command, `<!-- public names -->` by
the documentation of everything that `marey` exports, `<!-- examples -->` by the scripts in examples/, and
`<!-- bibliography -->` by docs/references.bib. `<!-- source FILE NAME -->` becomes the code of a class or function. A
citation
such as `[Rosenhahn2006]` becomes a link to the bibliography. Formulas between dollar signs become MathML, which
browsers show without a script.
"""

import ast
import html
import importlib
import inspect
import json
import re
from pathlib import Path
from typing import Any

import latex2mathml.converter
import typer
from mkdocs.structure.files import File

DOCS = Path(__file__).parents[1]
BIBLIOGRAPHY = "reference/bibliography.md"

_CITATION = re.compile(r"\[([A-Z][A-Za-z]+\d{4}[a-z]?)\](?![(\[]|: *\S)")
_CODE = re.compile(r"(^ *```.*?^ *```[^\n]*$|^(?: {4}|\t)[^\n]*$|`[^`\n]+`)", re.MULTILINE | re.DOTALL)
_SOURCE = re.compile(r"<!-- source (\S+) (\w+) -->")
_FORMULA = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)


def on_config(config: Any) -> Any:
    """Add the pages that are not listed by hand: of the benchmarks behind docs/accuracy.md, and of the notebooks."""
    measured = [path.relative_to(DOCS).as_posix() for path in sorted((DOCS / "accuracy").rglob("*.md"))]
    shown = [_notebook_page(path) for path in notebooks()]
    for entry in config["nav"]:
        if "Accuracy" in entry and measured:
            entry["Accuracy"] = ["accuracy.md", *measured]
        if "How to" in entry and shown:
            entry["How to"].append({"Notebooks": shown})
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add a page for every notebook in examples/."""
    for path in notebooks():
        files.append(File.generated(config, _notebook_page(path), content=notebook(path)))
    return files


def notebooks() -> list[Path]:
    """List the notebooks in examples/."""
    return sorted((DOCS.parent / "examples").rglob("*.ipynb"))


def _notebook_page(path: Path) -> str:
    return f"notebooks/{path.stem}.md"


def notebook(path: Path) -> str:
    """Write an executed notebook as Markdown: its texts, its code, and what the code printed and drew."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    parts = [_joined(cell["source"]) if cell["cell_type"] == "markdown" else _code_cell(cell) for cell in cells]
    name = path.relative_to(DOCS.parent).as_posix()
    return "\n\n".join([*parts, f"This page shows the notebook `{name}`."])


def _code_cell(cell: Any) -> str:
    parts = [f"```python\n{_joined(cell['source'])}\n```"]
    for output in cell.get("outputs", []):
        data = output.get("data", {})
        if "image/png" in data:
            code = "".join(_joined(data["image/png"]).split())
            parts.append(f'<img alt="Figure drawn by the code above" src="data:image/png;base64,{code}">')
        elif "text/html" in data:
            parts.append(f"<div>{_joined(data['text/html'])}</div>")
        else:
            text = _joined(output.get("text") or data.get("text/plain", "")).rstrip()
            parts += [f"```text\n{text}\n```"] if text else []
    return "\n\n".join(parts)


def _joined(text: str | list[str]) -> str:
    return text if isinstance(text, str) else "".join(text)


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Replace the markers, and link citations to the bibliography."""
    makers = {
        "commands": commands,
        "public names": public_names,
        "examples": examples,
        "bibliography": bibliography,
    }
    for name, make in makers.items():
        marker = f"<!-- {name} -->"
        if marker in markdown:
            markdown = markdown.replace(marker, make())
    markdown = _SOURCE.sub(lambda found: source_of(found.group(1), found.group(2)), markdown)
    path = page.file.src_uri
    return markdown if path == BIBLIOGRAPHY else linked_citations(markdown, path)


def on_page_content(content: str, page: Any, config: Any, files: Any) -> str:
    """Turn formulas into MathML."""
    return _FORMULA.sub(lambda found: _mathml(found.group(2)), content)


def linked_citations(markdown: str, path: str) -> str:
    """Make a link of every `[Key2006]` that stands in the bibliography, outside of code."""
    known = set(entries())
    target = "../" * path.count("/") + BIBLIOGRAPHY

    def link(found: re.Match[str]) -> str:
        key = found.group(1)
        return f"[{key}]({target}#{key.lower()})" if key in known else found.group(0)

    parts = _CODE.split(markdown)
    return "".join(part if i % 2 else _CITATION.sub(link, part) for i, part in enumerate(parts))


def _mathml(formula: str) -> str:
    text = html.unescape(re.sub(r"<[^>]+>", "", formula)).strip()
    block = text.startswith(r"\[")
    return latex2mathml.converter.convert(text[2:-2].strip(), display="block" if block else "inline")


def commands() -> str:
    """Describe every command of the program in Markdown, from the program itself."""
    from marey.cli.main import app

    return "\n\n".join(_command(command, ("marey",)) for command in _leaves(typer.main.get_command(app)))


def _leaves(group: Any, above: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any]]:
    found: list[tuple[tuple[str, ...], Any]] = []
    for name, command in group.commands.items():
        here = (*above, name)
        found += _leaves(command, here) if hasattr(command, "commands") else [(here, command)]
    return found


def _command(named: tuple[tuple[str, ...], Any], program: tuple[str, ...]) -> str:
    names, command = named
    usage = " ".join(
        (*program, *names, *(_usage(each) for each in command.params if each.param_type_name == "argument"))
    )
    lines = [f"## marey {' '.join(names)}", "", "```text", f"{usage} [OPTIONS]", "```", "", _help(command.help)]
    for title, kind in (("Arguments", "argument"), ("Options", "option")):
        rows = [
            _row(each) for each in command.params if each.param_type_name == kind and not getattr(each, "hidden", False)
        ]
        if rows:
            lines += ["", f"| {title[:-1].lower()} | meaning | default |", "| --- | --- | --- |", *rows]
    return "\n".join(lines)


def _usage(argument: Any) -> str:
    return argument.metavar or argument.name.upper()


def _help(text: str | None) -> str:
    # A list needs an empty line before it in Markdown.
    return re.sub(r"(Examples?:)\n\*", r"\1\n\n*", inspect.cleandoc(text or ""))


def _row(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        name = f"`{_usage(parameter)}`"
    else:
        spelled = ", ".join([*parameter.opts, *parameter.secondary_opts])
        value = "" if parameter.is_flag else f" {parameter.metavar or 'VALUE'}"
        name = f"`{spelled}{value}`"
    text = (parameter.help or "").replace("\\[", "[")
    given = re.search(r"\s*\[default: ([^\]]+)\]", text)
    default = given.group(1) if given else _default(parameter)
    return f"| {_cell(name)} | {_cell(text.replace(given.group(0), '') if given else text)} | {_cell(default)} |"


def _default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    value = parameter.default
    if value is None or callable(value) or getattr(parameter, "is_flag", False) or value in ((), [], 0):
        return ""
    return f"`{value}`"


def _cell(text: str) -> str:
    parts = re.split(r"(`[^`]*`)", " ".join(text.split()))
    return "".join(part if i % 2 else part.replace("|", "\\|") for i, part in enumerate(parts))


def public_names() -> str:
    """Document everything that `marey` exports: a table of all names, then functions, classes and errors."""
    marey = importlib.import_module("marey")
    names = [name for name in getattr(marey, "__all__", ()) if not name.startswith("__")]
    values = {name: getattr(marey, name) for name in names}
    kinds: dict[str, list[str]] = {"Functions": [], "Classes": [], "Errors": []}
    for name, value in values.items():
        error = inspect.isclass(value) and issubclass(value, BaseException)
        kinds["Errors" if error else "Classes" if inspect.isclass(value) else "Functions"].append(name)
    lines = ["| name | |", "| --- | --- |"]
    for found in kinds.values():
        lines += [f"| [`{name}`][{_full_name(values[name], name)}] | {_summary(values[name])} |" for name in found]
    for kind, found in kinds.items():
        lines += ["", f"## {kind}"] if found else []
        for name in found:
            lines += ["", f"::: {_full_name(values[name], name)}", "    options:", "      heading_level: 3"]
    return "\n".join(lines)


def _full_name(value: Any, name: str) -> str:
    return f"{getattr(value, '__module__', 'marey')}.{getattr(value, '__qualname__', name)}"


def _summary(value: Any) -> str:
    return _cell((inspect.getdoc(value) or "").split("\n\n")[0])


def examples() -> str:
    """Show every script in examples/, with its docstring as text and the rest as code."""
    parts = []
    for path in sorted((DOCS.parent / "examples").glob("*.py")):
        source = path.read_text(encoding="utf-8")
        title, _, text = (ast.get_docstring(ast.parse(source)) or path.stem).partition("\n")
        code = re.sub(r'^("""|\'\'\').*?\1\n+', "", source, count=1, flags=re.DOTALL)
        name = f"`examples/{path.name}`"
        parts.append(f"### {title.rstrip('.')}\n\n{name}\n\n{text.strip(chr(10))}\n\n```python\n{code.rstrip()}\n```")
    return "\n\n".join(parts)


def source_of(file: str, name: str) -> str:
    """Show a class or function of the package with its decorators, as code."""
    text = (DOCS.parent / "src" / "marey" / file).read_text(encoding="utf-8")
    node = next(node for node in ast.parse(text).body if getattr(node, "name", "") == name)
    first = min([node.lineno, *(each.lineno for each in node.decorator_list)])  # type: ignore[attr-defined]
    lines = text.splitlines()[first - 1 : node.end_lineno]
    return "\n".join(["```python", *lines, "```"])


def entries() -> dict[str, str]:
    """Read docs/references.bib: the text of every entry by its key."""
    text = (DOCS / "references.bib").read_text(encoding="utf-8")
    return {found.group(1): body for found in re.finditer(r"^@\w+\{([^,\s]+),", text, re.MULTILINE)
            if (body := _entry(text, found.end()))}  # fmt: skip


def _entry(text: str, start: int) -> str:
    depth, end = 1, start
    while depth:
        depth += {"{": 1, "}": -1}.get(text[end], 0)
        end += 1
    return text[start : end - 1]


def bibliography() -> str:
    """Write the bibliography as a list, by key."""
    return "\n\n".join(
        _reference(key, body) for key, body in sorted(entries().items(), key=lambda each: each[0].lower())
    )


def _reference(key: str, body: str) -> str:
    fields = {name.lower(): _plain(value) for name, value in _fields(body)}
    authors = fields.get("author", fields.get("editor", "")).replace(" and ", "; ")
    place = (
        fields.get("journal") or fields.get("booktitle") or fields.get("publisher") or fields.get("institution") or ""
    )
    volume = fields.get("volume", "") + (f"({fields['number']})" if "number" in fields and "volume" in fields else "")
    rest = ", ".join(each for each in (place and f"*{place}*", volume, fields.get("pages", "")) if each)
    doi = f", doi {fields['doi']}" if "doi" in fields else ""
    heading = f"### {key} {{ #{key.lower()} }}"
    return f"{heading}\n\n{authors} ({fields.get('year', '')}). {fields.get('title', '')}. {rest}{doi}."


def _fields(body: str) -> list[tuple[str, str]]:
    found = []
    for name in re.finditer(r"(\w+)\s*=\s*\{", body):
        depth, end = 1, name.end()
        while depth:
            depth += {"{": 1, "}": -1}.get(body[end], 0)
            end += 1
        found.append((name.group(1), body[name.end() : end - 1]))
    return found


_ACCENTS = {'"': "\u0308", "'": "\u0301", "`": "\u0300", "^": "\u0302", "~": "\u0303", "=": "\u0304", "u": "\u0306",
            "v": "\u030c", "r": "\u030a", "c": "\u0327"}  # fmt: skip
_LETTERS = {
    r"\ae": "æ",
    r"\AE": "Æ",
    r"\aa": "å",
    r"\AA": "Å",
    r"\o": "ø",
    r"\O": "Ø",
    r"\ss": "ß",
    r"\l": "ł",
    r"\i": "ı",
}


def _plain(text: str) -> str:
    """Turn LaTeX accents and braces into plain letters."""
    import unicodedata

    def accent(found: re.Match[str]) -> str:
        letter = found.group(2).replace("\\i", "i")
        return unicodedata.normalize("NFC", letter + _ACCENTS[found.group(1)])

    text = re.sub(r"\\([\"'`^~=]|[uvrc](?=\{|\s))\s*\{?(\\?\w)\}?", accent, text)
    for name, letter in _LETTERS.items():
        text = re.sub(re.escape(name) + r"(?![a-zA-Z])\s*", letter, text)
    text = text.replace("\\&", "&").replace("--", "\u2013").replace("{", "").replace("}", "")
    return " ".join(text.split())
