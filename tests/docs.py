"""Builds the pages of the API and the guides: ``python tests/docs.py FOLDER``, or ``make docs``.

The API comes from the docstrings by way of pdoc; the guides are README, CONTRIBUTING, CHANGELOG, every page that they
link to, and the executed notebooks. A warning of pdoc's, a public name without a page, and a link that leads nowhere
all end it with an error.
"""

import importlib
import inspect
import os
import pkgutil
import re
import shutil
import sys
import warnings
from pathlib import Path

import markdown2
import nbconvert
import nbformat

ROOT = Path(__file__).resolve().parent.parent
GUIDES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
# A program of its own, which imports MuJoCo at its top; it has no names for others.
NO_MODULES = ("ipjax.rendering.child", "ipjax.__main__")
LINK = re.compile(r'(href|src)="(?!https?:|#|data:|mailto:)([^"#?]+)')
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }}
pre, code {{ font: 0.9em/1.4 ui-monospace, monospace; background: #f5f5f5; }}
pre {{ padding: 0.8rem; overflow-x: auto; }}
table {{ border-collapse: collapse; display: block; overflow-x: auto; }}
th, td {{ border: 1px solid #ddd; padding: 0.3rem 0.6rem; text-align: left; vertical-align: top; }}
img {{ max-width: 100%; }} a {{ color: #0550ae; }}
</style></head><body><p><a href="{up}index.html">API</a> · <a href="{up}guide/README.html">README</a></p>
{body}</body></html>
"""


def build(folder: Path) -> list[str]:
    """Write all pages; returns the names of the modules documented.

    Raises RuntimeError where a public name has no page, a link leads nowhere, or a page has a path of this machine; and
    whatever pdoc warns of.
    """
    os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is drawn, and pdoc keeps MuJoCo from looking for a display
    shutil.rmtree(folder, ignore_errors=True)
    modules = build_api(folder)
    build_guides(folder / "guide")
    check_links(folder)
    return modules


def build_api(folder: Path) -> list[str]:
    """The pages of both packages."""
    import ipjax_kernels
    import pdoc
    import pdoc.render

    import ipjax

    for package in (ipjax, ipjax.metrics):  # their names are imported when first asked for; pdoc looks at what is there
        for name in package.__all__:
            setattr(package, name, getattr(package, name))
    ipjax.__doc__ = f"{ipjax.__doc__}\n\n{list_guides()}"
    names = [
        module.name
        for package in (ipjax, ipjax_kernels)
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + ".")
        if module.name not in NO_MODULES
    ]
    # pdoc takes the modules of a package along, but not those of packages that list their public names.
    tops = [name for name in names if name.rpartition(".")[0] in ("ipjax", "ipjax.metrics")]
    pdoc.render.configure(docformat="google", search=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        pdoc.pdoc("ipjax", "ipjax_kernels", *tops, output_directory=folder)
    missing = [name for name in names if not (folder / f"{name.replace('.', '/')}.html").is_file()]
    for package in (ipjax, ipjax.metrics):
        text = (folder / f"{package.__name__.replace('.', '/')}.html").read_text()
        missing += [f"{package.__name__}.{name}" for name in package.__all__ if f'id="{name}"' not in text]
    for name in names:  # what a module declares and does not hide
        page = (folder / f"{name.replace('.', '/')}.html").read_text() if name not in missing else ""
        for key, value in vars(importlib.import_module(name)).items():
            declared = getattr(value, "__module__", None) == name and (
                inspect.isfunction(value) or inspect.isclass(value)
            )
            if declared and not key.startswith("_") and f'id="{key}"' not in page:
                missing.append(f"{name}.{key}")
    local = [str(page.relative_to(folder)) for page in sorted(folder.rglob("*.html")) if str(ROOT) in page.read_text()]
    if local:
        raise RuntimeError(f"a path of this machine stands in {', '.join(local)}")
    if missing:
        raise RuntimeError(f"no page tells of {', '.join(missing)}")
    return names


def list_guides() -> str:
    """Markdown: links to the guides, from the first page of the API."""
    lines = ["## Guides", ""]
    lines += [f"* [{name.removesuffix('.md')}](guide/{Path(name).stem}.html)" for name in GUIDES]
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        title = nbformat.read(path, as_version=4).cells[0].source.splitlines()[0].lstrip("# ")
        lines.append(f"* [{title}](guide/notebooks/{path.stem}.html)")
    return "\n".join(lines)


def build_guides(folder: Path) -> None:
    """README and what it leads to, as HTML in the tree's own order, so that relative links stay what they are."""
    waiting, done = [ROOT / name for name in GUIDES] + sorted((ROOT / "notebooks").glob("*.ipynb")), set()
    while waiting:
        path = waiting.pop()
        if path in done:
            continue
        done.add(path)
        target = folder / path.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".ipynb":
            body, _ = nbconvert.HTMLExporter(template_name="basic").from_filename(str(path))
        elif path.suffix == ".md":
            extras = ["tables", "fenced-code-blocks", "header-ids", "cuddled-lists"]
            body = markdown2.markdown(path.read_text(), extras=extras)
        else:
            shutil.copyfile(path, target)
            continue
        for _, link in LINK.findall(body):
            linked = (path.parent / link).resolve()
            if not linked.is_file() or ROOT not in linked.parents:
                raise RuntimeError(f"{path.relative_to(ROOT)} links to {link}, which is not here")
            waiting.append(linked)
        body = LINK.sub(lambda m: f'{m[1]}="{re.sub(r"[.](md|ipynb)$", ".html", m[2])}', body)
        up = "../" * (len(path.relative_to(ROOT).parts))
        page = PAGE.format(title=f"{path.stem} · ipjax", body=body, up=up)
        target.with_suffix(".html").write_text(page)


def check_links(folder: Path) -> None:
    """Every relative link of every page leads to a file that was built."""
    broken = {
        f"{page.relative_to(folder)} → {link}"
        for page in folder.rglob("*.html")
        for _, link in LINK.findall(re.sub(r"(?s)<script.*?</script>", "", page.read_text()))
        if not (page.parent / link).exists()
    }
    if broken:
        raise RuntimeError(f"links that lead nowhere: {', '.join(sorted(broken))}")


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT), str(ROOT / "kernels")]  # this tree, whichever one is installed
    target = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "out" / "docs")
    print(f"{len(build(target))} modules: {target / 'index.html'}")
