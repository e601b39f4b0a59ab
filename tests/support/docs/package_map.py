"""The map of the packages in ``cosim/DESIGN.md``, drawn from the imports of the code.

A node is a package of ``cosim``, a part, or the modules of ``cosim`` itself. Imports count everywhere, also in functions and
under ``TYPE_CHECKING``. An arrow is left out where a chain of others connects the two.
"""

import ast
import sys

from grimp import ImportGraph, build_graph

from tests.support.paths import ROOT

PAGE = ROOT / "cosim" / "DESIGN.md"
COMMAND = "python -m tests.support.docs.package_map --write"
BEGIN, END = f"<!-- map: written by {COMMAND} -->", "<!-- end of the map -->"
PARTS = ("agents", "hardware", "netsim", "physics")


def package_of(module: str) -> str | None:
    """Node of a module; None: the front door, which imports everything, and data."""
    _, *names = module.split(".")
    if names and names[0] in PARTS:
        return names[0]
    if not names or names[0] != "cosim":
        return None
    return ".".join(names[:2]) if ROOT.joinpath(*names[:2], "__init__.py").is_file() else "cosim"


def packages() -> ImportGraph:
    """The imports between packages."""
    modules, graph = build_graph("vcmvsp", cache_dir=None), ImportGraph()
    for module in modules.modules:
        importer = package_of(module)
        for target in modules.find_modules_directly_imported_by(module):
            imported = package_of(target)
            if importer and imported and importer != imported:
                graph.add_import(importer=importer, imported=imported)
    return graph


def imports(graph: ImportGraph) -> list[tuple[str, str]]:
    """Importer and imported, in order."""
    return sorted((each, imported) for each in graph.modules for imported in graph.find_modules_directly_imported_by(each))


def without_implied(graph: ImportGraph) -> ImportGraph:
    """Imports without those that a chain of others implies."""
    for importer, imported in imports(graph):
        graph.remove_import(importer=importer, imported=imported)
        if not graph.chain_exists(importer=importer, imported=imported):
            graph.add_import(importer=importer, imported=imported)
    return graph


def purpose(package: str) -> str:
    """The first paragraph of a package's docstring."""
    text = (ROOT.joinpath(*package.split(".")) / "__init__.py").read_text("utf-8")
    return " ".join((ast.get_docstring(ast.parse(text)) or "").partition("\n\n")[0].split())


def draw() -> str:
    """The map: the graph in Mermaid, and a table of the packages."""
    graph = without_implied(packages())
    names = sorted(graph.modules)
    nodes = [f'    {name}["{name.removeprefix("cosim.")}"]' for name in names]
    arrows = [f"    {importer} --> {imported}" for importer, imported in imports(graph)]
    shaded = ["    classDef part fill:#fde9c9,stroke:#c77c02", f"    class {','.join(PARTS)} part"]
    rows = [f"| `{name}` | {purpose(name)} |" for name in names]
    picture = ["```mermaid", "flowchart TD", *nodes, *arrows, *shaded, "```"]
    return "\n".join([BEGIN, *picture, "", "| package | holds |", "|---|---|", *rows, END])


def page_with_map(page: str) -> str:
    """The page with the map in its place."""
    before, _, rest = page.partition(BEGIN)
    return before + draw() + rest.partition(END)[2]


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        sys.exit(f"usage: {COMMAND}")
    PAGE.write_text(page_with_map(PAGE.read_text("utf-8")), "utf-8")
