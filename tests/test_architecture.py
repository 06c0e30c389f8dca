"""The order of the package's folders: no import goes up, or round in a circle (docs/architecture.md)."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest

import polarmpm
from polarmpm.basis.registry import BASES

PACKAGE = Path(polarmpm.__file__).parent
ORDER = (
    *("errors", "tools", "kernels", "solvers", "geometry", "kinematics", "basis", "materials", "bodies"),
    *("forms", "conditions", "terms", "assembly", "problems", "sensitivity", "io", "plot"),
    *("identification", "geotechnics", "study"),
)
USE = ("sensitivity", "io", "plot", "identification", "geotechnics", "study")  # what the solver does without
MODULE_LINES, FUNCTION_LINES = 450, 60

Name = tuple[str, ...]


def modules() -> dict[Name, Path]:
    """All modules by their dotted names, as tuples without the package's own."""
    found = {}
    for path in PACKAGE.rglob("*.py"):
        if path.name == "__main__.py":
            continue  # not of the library: it uses all of it
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[parts[:-1] if parts[-1] == "__init__" else parts] = path
    return found


MODULES = modules()


def imports(name: Name) -> Iterator[Name]:
    """Modules of the package that a module imports, wherever in it."""
    path = MODULES[name]
    package = name if path.name == "__init__.py" else name[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            start = package[: len(package) - node.level + 1]
            target = (*start, *(node.module.split(".") if node.module else ()))
            for alias in node.names:
                yield (*target, alias.name) if (*target, alias.name) in MODULES else target
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "polarmpm":
            pytest.fail(f"{'.'.join(name)} imports {node.module} by its absolute name")


IMPORTS = {name: set(imports(name)) for name in MODULES}


def test_every_folder_has_its_place():
    assert {name[0] for name in MODULES if name} == set(ORDER)
    assert len(list(PACKAGE.glob("*.py"))) <= 6


def test_no_folder_imports_from_a_higher_one():
    upward = [
        f"{'.'.join(name)} imports {'.'.join(other)}"
        for name, others in IMPORTS.items()
        for other in others
        if name and other and ORDER.index(other[0]) > ORDER.index(name[0])
    ]
    assert not upward, "\n".join(upward)


def test_nothing_is_imported_in_a_circle():
    open_: list[Name] = []
    done: set[Name] = set()

    def visit(name: Name) -> None:
        assert name not in open_, " -> ".join(".".join(n) for n in (*open_, name))
        if name not in done:
            open_.append(name)
            for other in IMPORTS[name]:
                visit(other)
            done.add(open_.pop())

    for name in MODULES:
        if name:  # the package's own face imports everything
            visit(name)


def test_the_solver_does_without_files_and_figures():
    found = {
        ".".join(name): ".".join(other)
        for name, others in IMPORTS.items()
        for other in others
        if name and other and other[0] in USE and name[0] not in USE
    }
    assert not found


def test_the_face_only_re_exports():
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    own = [n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    assert own in ([], ["__getattr__"])
    for name in polarmpm.__all__:
        assert getattr(polarmpm, name) is not None


def test_modules_and_functions_are_short():
    long = []
    for name, path in MODULES.items():
        text = path.read_text()
        if text.count("\n") > MODULE_LINES:
            long.append(f"{'.'.join(name)}: {text.count(chr(10))} lines")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and node.end_lineno - node.lineno >= FUNCTION_LINES:
                long.append(f"{'.'.join(name)}.{node.name}: {node.end_lineno - node.lineno + 1} lines")
    assert not long, "\n".join(long)


# seams --------------------------------------------------------------------------------------------------
# what the other folders see of it
FACES_OF_A_BASIS = {("basis", "base"), ("basis", "followed"), ("basis", "registry")}


def is_basis(node: ast.AST) -> bool:
    """An expression for a basis or its name: basis, self.basis, problem.basis.name, ..."""
    return ast.unparse(node).removesuffix(".name").split(".")[-1] == "basis"


def asks_for_a_basis(node: ast.AST) -> bool:
    """Whether code depends on which basis there is: by comparing it or a name, a look-up, or its class."""
    constants = {n.value for n in ast.walk(node) if isinstance(n, ast.Constant)}
    named = any(isinstance(c, str) and c in BASES for c in constants)
    if isinstance(node, ast.Compare):
        return named or any(is_basis(side) for side in (node.left, *node.comparators))
    if isinstance(node, ast.Match):
        return named or is_basis(node.subject)
    if isinstance(node, ast.Dict):  # a table by names
        return any(isinstance(key, ast.Constant) and key.value in BASES for key in node.keys)
    if isinstance(node, ast.Subscript):
        return is_basis(node.slice)
    if isinstance(node, ast.Call):
        called = ast.unparse(node.func)
        of_class = called in ("isinstance", "type") and bool(node.args) and is_basis(node.args[0])
        text = called.split(".")[-1] in ("startswith", "endswith", "get", "removeprefix", "index", "find")
        return of_class or (text and (named or any(is_basis(a) for a in node.args)))
    return False


def test_only_the_basis_folder_asks_for_a_basis():
    found = [
        f"{'.'.join(name)}, line {node.lineno}: {ast.unparse(node)}"
        for name, path in MODULES.items()
        if name[:1] != ("basis",)
        for node in ast.walk(ast.parse(path.read_text()))
        if asks_for_a_basis(node)
    ]
    inside = [
        f"{'.'.join(name)} imports {'.'.join(other)}"
        for name, others in IMPORTS.items()
        if name[:1] != ("basis",)
        for other in others
        if other[:1] == ("basis",) and other not in FACES_OF_A_BASIS
    ]
    assert not found + inside, "\n".join(found + inside)


@pytest.mark.parametrize(
    "code",
    [
        'basis == "bspline"',
        'self.basis.name != "mpm"',
        '"gimpm" == kind',
        'basis in ("bspline", "bspline3")',
        "basis in TABLE",
        'kind not in {"mpm"}',
        "TABLE[self.basis]",
        "TABLE.get(basis.name)",
        'basis.name.startswith("bspline")',
        'reasons = {"gimpm": 1, "bspline": 2}',
        "isinstance(self.basis, Splines)",
        "type(basis) is Tents",
        'match basis:\n    case "mpm":\n        pass',
    ],
)
def test_questions_for_a_basis_are_found(code):
    assert any(asks_for_a_basis(node) for node in ast.walk(ast.parse(code)))


def test_only_the_grid_knows_that_its_planes_are_equidistant():
    """No other module reads `cell` of a grid; a mesh's `cell` is the name of its cells' shape."""
    found = [
        f"{'.'.join(name)}, line {node.lineno}: {ast.unparse(node)}"
        for name, path in MODULES.items()
        if name not in (("geometry", "grid"), ("geometry", "meshes"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute) and node.attr == "cell"
        if ast.unparse(node.value).split(".")[-1] != "body"
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "problem", [polarmpm.QuasiStatic, polarmpm.QuasiStaticFEM, polarmpm.Dynamic, polarmpm.DynamicFEM]
)
def test_parts_of_a_problem_do_not_hide_one_another(problem):
    """Of two classes neither of which is the other's base, the second one's method would be gone silently."""
    parts = [part for part in problem.__mro__ if part.__module__.startswith("polarmpm.")]
    for k, first in enumerate(parts):
        for second in parts[k + 1 :]:
            if issubclass(first, second):
                continue
            for name in set(vars(first)) & set(vars(second)) - {"_abc_impl"}:
                if name.startswith("__") or getattr(vars(second)[name], "__isabstractmethod__", False):
                    continue
                code = inspect.getsource(inspect.unwrap(getattr(first, name)))
                assert f"super().{name}" in code, f"{name} of {first.__name__} and {second.__name__}"
