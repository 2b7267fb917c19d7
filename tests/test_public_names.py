"""Each public name of the package has one import path: its module, which has it in `__all__`."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "sliceit_drake"


def module_name(file: Path, package: Path) -> str:
    parts = [package.name, *file.relative_to(package).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def listed(tree: ast.Module) -> list[str]:
    """What `__all__` holds; nothing where there is none."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return list(ast.literal_eval(node.value))
    return []


def definitions(tree: ast.Module) -> list[ast.FunctionDef | ast.ClassDef]:
    return [node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]


def made_here(tree: ast.Module) -> set[str]:
    """Names that a module defines or assigns, rather than imports."""
    names = {node.name for node in definitions(tree)}
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)}
    return names


def is_of_a_kernel(node: ast.FunctionDef | ast.ClassDef) -> bool:
    """Whether it is a function of Warp's, which only kernels beside it call."""
    return any(ast.unparse(decorator) == "wp.func" for decorator in node.decorator_list)


def order(name: str) -> tuple[int, str]:
    """Constants, classes, functions, as ruff's RUF022 sorts them."""
    return (0 if name.isupper() else 1 if name[0].isupper() else 2, name)


def violations(package: Path) -> list[str]:
    """A line for each name under `package` that has no import path, or more than one."""
    files = sorted(package.rglob("*.py"))
    trees = {file: ast.parse(file.read_text(encoding="utf-8"), str(file)) for file in files}
    exports = {module_name(file, package): listed(tree) for file, tree in trees.items()}
    problems = []
    for file, tree in trees.items():
        place = f"{package.name}/{file.relative_to(package)}"
        names = exports[module_name(file, package)]
        if names != sorted(names, key=order):
            problems.append(f"{place}: __all__ is not sorted: {sorted(names, key=order)}")
        for name in sorted(set(names) - made_here(tree)):
            problems.append(f"{place}: {name} is in __all__ and made elsewhere")
        for node in definitions(tree):
            if not node.name.startswith("_") and node.name not in names:
                if not is_of_a_kernel(node):
                    problems.append(f"{place}: {node.name} is public and not in __all__")
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module in exports:
                for alias in node.names:
                    is_module = f"{node.module}.{alias.name}" in exports
                    if not is_module and alias.name not in exports[node.module]:
                        problems.append(
                            f"{place}:{node.lineno}: {node.module} has no {alias.name} in __all__"
                        )
    return problems


def test_each_public_name_has_one_import_path():
    assert violations(PACKAGE) == []


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('__all__ = ["f"]\ndef f(): ...\ndef g(): ...', "g is public and not in __all__"),
        ("class Food: ...", "Food is public and not in __all__"),
        ('__all__ = ["b", "A"]\ndef b(): ...\nclass A: ...', "__all__ is not sorted: ['A', 'b']"),
        ('from pkg.a import f\n__all__ = ["f"]', "f is in __all__ and made elsewhere"),
        ("def _f():\n    from pkg.a import LIMIT", "b.py:2: pkg.a has no LIMIT in __all__"),
    ],
)
def test_a_name_without_one_import_path_is_found(tmp_path, text, problem):
    package = tmp_path / "pkg"
    package.mkdir()
    (package / "a.py").write_text('__all__ = ["f"]\nLIMIT = 1.0\ndef f(): ...', encoding="utf-8")
    (package / "b.py").write_text(text, encoding="utf-8")
    (found,) = violations(package)
    assert problem in found


def test_what_is_listed_private_or_of_a_kernel_is_let_through(tmp_path):
    package = tmp_path / "pkg"
    package.mkdir()
    (package / "__init__.py").write_text("", encoding="utf-8")
    (package / "a.py").write_text(
        '__all__ = ["LIMIT", "Food", "cut"]\nLIMIT: float = 1.0\nclass Food: ...\n'
        "def cut(): ...\ndef _help(): ...\n@wp.func\ndef inner(): ...",
        encoding="utf-8",
    )
    (package / "b.py").write_text("from pkg import a\nfrom pkg.a import LIMIT", encoding="utf-8")
    assert violations(package) == []
