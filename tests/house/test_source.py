"""House rules that a machine can check by reading the source, beyond those of ruff and import-linter. CONTRIBUTING.md
says why each exists."""

from __future__ import annotations

import ast
import functools
import gc
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import networkx
import pytest

MAX_FILE_LINES = 940
MAX_FUNCTION_LINES = 100  # without the docstring
MAX_PARAMETERS = 10  # without self and cls

# Modules that `mudg --help` loads, or that plain `import mudg` may reach: torch only inside functions.
TORCH_FREE = (
    "__init__.py __main__.py app.py steps/*.py */settings.py */*_settings.py benchmarks/step.py base/*.py".split()
)
TORCH_ALLOWED = ("base/checkpoint.py", "base/weights.py")

FORBIDDEN_MODULES = set("pickle cPickle dill cloudpickle joblib marshal shelve random torchvision".split())
LITERAL_TABLES = (
    *("__init__.py", "formats/importers/__init__.py", "gaussians/model.py", "gaussians/recipes.py"),
    *("steps/__init__.py", "steps/step.py"),
)
"""Files that import by names, all of which stand in a table beside."""
FORBIDDEN_CALLS = set(
    "eval exec compile __import__ os.system os.popen os.execv os.fork tempfile.mktemp yaml.load yaml.unsafe_load "
    "yaml.full_load torch.manual_seed torch.seed torch.hub.load torch.jit.load "
    "np.random.seed np.load numpy.load".split()
)
WRITERS = set("np.save np.savez np.savez_compressed np.savetxt torch.save json.dump yaml.dump save_file".split())
DRAWS = set("rand randn randint randperm normal bernoulli multinomial poisson rand_like randn_like".split())
IN_PLACE_DRAWS = set("normal_ uniform_ random_ bernoulli_ exponential_ trunc_normal_".split())
CONNECTS = (
    "socket ssl urllib.request http ftplib smtplib poplib imaplib telnetlib xmlrpc asyncio requests httpx aiohttp "
    "websockets paramiko fsspec s3fs gcsfs adlfs ray submitit torch.distributed torch.hub"
).split()
CONNECTING = {
    "base/location.py": {"fsspec", "ssl"},
    "fleet/engines.py": {"ray", "submitit"},
    "diffusion/parallel.py": {"torch.distributed"},
    "viewer/server.py": {"http"},
    "sim/server.py": {"http"},  # counts for Prometheus, on loopback; gRPC itself is grpcio
    "viewer/view.py": {"http"},
}
"""Modules that may reach a network, and what of. SECURITY.md tells when they do."""
READS_OF_OTHERS = {"base/memory.py", "base/processes.py", "native/__init__.py", "steps/step.py", "viewer/page.py"}
"""Files that read what the system, or this package itself, provides."""


@functools.lru_cache(maxsize=2000)
def syntax_of(path: Path, _modified_ns: int) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


@functools.lru_cache(maxsize=4000)
def walk(tree: ast.AST) -> tuple[ast.AST, ...]:
    """All nodes of a tree, in the order of ``ast.walk``; listed once for all rules."""
    return tuple(ast.walk(tree))


@pytest.fixture(autouse=True, scope="module")
def _syntax_without_collections() -> Iterator[None]:
    """Millions of nodes make each pass of the garbage collector slow: none runs here, and the nodes go at the end."""
    gc.disable()
    yield
    for cached in (syntax_of, walk, calls, imported_modules):
        cached.cache_clear()
    gc.enable()


def parsed(package_dir: Path) -> Iterator[tuple[str, ast.Module]]:
    found = sorted(package_dir.rglob("*.py"))
    assert len(found) > 10, "the package's sources were not found"
    for path in found:
        yield path.relative_to(package_dir).as_posix(), syntax_of(path, path.stat().st_mtime_ns)


def dotted(node: ast.AST) -> str:
    """Return ``a.b.c`` for an attribute chain, '' for anything else."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(parts)]) if isinstance(node, ast.Name) else ""


@functools.lru_cache(maxsize=4000)
def calls(tree: ast.AST) -> list[tuple[ast.Call, str]]:
    return [(node, dotted(node.func)) for node in walk(tree) if isinstance(node, ast.Call)]


def method_of(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else ""


@functools.lru_cache(maxsize=4000)
def imported_modules(tree: ast.AST) -> list[tuple[int, str]]:
    """Return (line, dotted module) of every import, late ones included, type-checking ones left out."""
    skipped: set[ast.AST] = set()
    for node in walk(tree):
        if isinstance(node, ast.If) and dotted(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            skipped.update(inner for child in node.body for inner in ast.walk(child))
    imports = []
    for node in walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            imports += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: imports are absolute in this package"
            imports += [(node.lineno, f"{node.module}.{alias.name}") for alias in node.names]
    return imports


def refuse(problems: list[str]) -> None:
    assert not problems, "\n" + "\n".join(problems)


def test_only_these_modules_can_open_a_connection(package_dir: Path, repository: Path) -> None:
    problems = []
    for name, tree in parsed(package_dir):
        for line, module in imported_modules(tree):
            kind = next((one for one in CONNECTS if module == one or module.startswith(f"{one}.")), None)
            if kind not in (None, "socket") and kind not in CONNECTING.get(name, ()):
                problems.append(f"{name}:{line}: imports {module}")
        for node in walk(tree) if name not in CONNECTING else ():
            of_socket = isinstance(node, ast.Attribute) and dotted(node).startswith("socket.")
            if of_socket and node.attr not in ("gethostname", "timeout"):
                problems.append(f"{name}:{node.lineno}: socket.{node.attr}")
    refuse(problems)
    told = (repository / "SECURITY.md").read_text(encoding="utf-8")
    for word in ("s3://", "ray", "slurm", "torchrun", "mudg view", "credentials", "--token", "127.0.0.1"):
        assert word in told, word


def test_torch_is_not_imported_where_help_must_be_fast(package_dir: Path) -> None:
    allowed = {package_dir / name for name in TORCH_ALLOWED}
    problems = []
    for path in sorted({path for pattern in TORCH_FREE for path in package_dir.glob(pattern)} - allowed):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        at_the_top = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom | ast.Try | ast.With)]
        for line, module in (found for node in at_the_top for found in imported_modules(node)):
            if module.split(".")[0] in ("torch", "scipy", "av"):
                problems.append(f"{path.relative_to(package_dir)}:{line}: imports {module} at the top")
    refuse(problems)


def test_nothing_executes_data(package_dir: Path) -> None:
    problems = []
    for name, tree in parsed(package_dir):
        imported = ((line, module) for line, module in imported_modules(tree))
        problems += [f"{name}:{at}: imports {one}" for at, one in imported if one.split(".")[0] in FORBIDDEN_MODULES]
        for call, function in calls(tree):
            if function in FORBIDDEN_CALLS:
                problems.append(f"{name}:{call.lineno}: calls {function}")
            if function == "torch.load" and name != "base/weights.py":
                problems.append(f"{name}:{call.lineno}: torch.load belongs to base/weights.py alone")
            by_name = function.endswith(("import_module", "resolve_name")) and not isinstance(
                call.args[0], ast.Constant
            )
            if by_name and name not in LITERAL_TABLES:
                problems.append(f"{name}:{call.lineno}: a computed name becomes an import")
            for keyword in call.keywords:
                value = keyword.value.value if isinstance(keyword.value, ast.Constant) else None
                if (keyword.arg in ("shell", "allow_pickle") and value is not False) or (
                    keyword.arg in ("weights_only", "verify") and value is False
                ):
                    problems.append(f"{name}:{call.lineno}: {keyword.arg}={ast.unparse(keyword.value)}")
    refuse(problems)


def test_only_the_store_opens_files(package_dir: Path) -> None:
    """It writes under temporary names, and looks before it opens: where a file should be, a pipe or a device may lie.
    And YAML is bounded in one place."""
    problems = []
    for name, tree in parsed(package_dir):
        for call, function in calls(tree) if name != "base/store.py" else ():
            method, where = method_of(call), f"{name}:{call.lineno}:"
            if (
                function in ("yaml.safe_load", "yaml.compose", "yaml.parse", "yaml.scan")
                and name != "base/plain_yaml.py"
            ):
                problems.append(f"{where} {function} without bounds")
            given = [*call.args[:2], *(keyword.value for keyword in call.keywords if keyword.arg == "mode")]
            modes = [one.value for one in given if isinstance(one, ast.Constant) and isinstance(one.value, str)]
            opens = "open" in (function, method) and function != "av.open"
            if opens and any(re.fullmatch(r"[rbt]*[wax+][rwabtx+]*", mode) for mode in modes):
                problems.append(f"{where} opens a file for writing")
            if method in ("write_text", "write_bytes") and not function.startswith("store."):
                problems.append(f"{where} {ast.unparse(call.func)}")
            if function in WRITERS:
                problems.append(f"{where} {function} writes without the store")
            if name in READS_OF_OTHERS:
                continue
            if opens and any(re.fullmatch(r"[rbt]+", mode) for mode in modes):
                problems.append(f"{where} opens a file")
            if method in ("read_text", "read_bytes") and not function.startswith("store."):
                problems.append(f"{where} {ast.unparse(call.func)}")
            if function == "Image.open" and not ast.unparse(call.args[0]).startswith(("io.BytesIO", "'", '"')):
                problems.append(f"{where} opens a picture by its name")
            if function.endswith("safe_open") and "store.regular" not in ast.unparse(call):
                problems.append(f"{where} opens a file by its name")
    refuse(problems)


def test_outputs_are_kept_apart_from_inputs(package_dir: Path) -> None:
    """A verb's folder is opened after its inputs were compared with it; two open folders of their own results."""
    problems = []
    for name, tree in parsed(package_dir):
        opened = [call.lineno for call, function in calls(tree) if function.endswith("RunDir.open")]
        compared = [call.lineno for call, function in calls(tree) if function.endswith("refuse_overlap")]
        if len(compared) < len(opened) and name not in ("benchmarks/cities.py", "diffusion/city_clips.py"):
            problems.append(f"{name}:{opened[0]}: RunDir.open without refuse_overlap")
    refuse(problems)


def test_no_global_random_state(package_dir: Path) -> None:
    problems = []
    for name, tree in parsed(package_dir):
        for call, function in calls(tree) if name != "base/seeds.py" else ():
            named, parts = {keyword.arg for keyword in call.keywords}, function.split(".")
            of_torch = parts[0] == "torch" and parts[-1] in DRAWS and len(parts) == 2
            if (of_torch or method_of(call) in IN_PLACE_DRAWS) and "generator" not in named:
                problems.append(f"{name}:{call.lineno}: {function or method_of(call)} without generator=")
            if function.startswith(("np.random.", "numpy.random.")):
                problems.append(f"{name}:{call.lineno}: {function}: draw from mudg.base.seeds")
    refuse(problems)


def test_files_and_functions_stay_short_and_take_few_parameters(package_dir: Path) -> None:
    problems = []
    for path in sorted(package_dir.rglob("*.py")):
        if (lines := path.read_text(encoding="utf-8").count("\n")) > MAX_FILE_LINES:
            problems.append(f"{path.relative_to(package_dir)}: {lines} lines")
    for name, tree in parsed(package_dir):
        for node in walk(tree):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            length = (node.end_lineno or 0) - node.lineno + 1
            if ast.get_docstring(node, clean=False) is not None:
                length -= (node.body[0].end_lineno or 0) - node.body[0].lineno + 1
            if length > MAX_FUNCTION_LINES:
                problems.append(f"{name}:{node.lineno}: {node.name} has {length} lines")
            every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            count = sum(argument.arg not in ("self", "cls", "ctx") for argument in every)
            if count > MAX_PARAMETERS:
                problems.append(f"{name}:{node.lineno}: {node.name} takes {count} parameters")
    refuse(problems)


def test_class_names_are_unique(package_dir: Path) -> None:
    """A name that two classes share cannot be searched for."""
    homes: dict[str, list[str]] = {}
    for name, tree in parsed(package_dir):
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(f"{name}:{node.lineno}")
    refuse([f"{name}: {', '.join(places)}" for name, places in sorted(homes.items()) if len(places) > 1])


def test_no_import_cycles_even_late_ones(package_dir: Path) -> None:
    trees = {
        "mudg." + name.removesuffix(".py").removesuffix("/__init__").replace("/", "."): tree
        for name, tree in parsed(package_dir)
    }
    trees.pop("mudg.__init__", None)  # the lazy names of the package root
    graph = networkx.DiGraph()
    for module, tree in trees.items():
        for _, imported in imported_modules(tree):
            while imported and imported not in trees:
                imported = imported.rpartition(".")[0]
            if imported not in ("", module):
                graph.add_edge(module, imported)
    cycles = [sorted(group) for group in networkx.strongly_connected_components(graph) if len(group) > 1]
    refuse([" <-> ".join(group) for group in cycles])


def methods(tree: ast.Module, *, of_protocols: bool) -> set[str]:
    """Names of the documented methods of a module's classes, or of its protocols alone."""
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    chosen = [node for node in classes if not of_protocols or "Protocol" in map(dotted, node.bases)]
    inner = [one for node in chosen for one in node.body if isinstance(one, ast.FunctionDef)]
    return {one.name for one in inner if ast.get_docstring(one)}


def of_bases(node: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> set[str]:
    """Names of the methods that the bases of a class in the package document."""
    bases = [classes[name] for base in node.bases if (name := dotted(base).rpartition(".")[2]) in classes]
    own = {
        one.name for base in bases for one in base.body if isinstance(one, ast.FunctionDef) and ast.get_docstring(one)
    }
    return own.union(*(of_bases(base, classes) for base in bases))


def test_public_methods_are_documented(package_dir: Path) -> None:
    """But for torch's forward, and what a base of the class or of all verbs, or a protocol in the module, explains. Of
    functions, classes and annotations ruff takes care."""
    modules = dict(parsed(package_dir))
    classes = {node.name: node for tree in modules.values() for node in tree.body if isinstance(node, ast.ClassDef)}
    of_steps = {"steps/step.py", "steps/engine.py"} & modules.keys()
    explained_steps = {name for module in of_steps for name in methods(modules[module], of_protocols=False)}
    explained_steps |= {"run_parts", "settings_in_list"}
    problems = []
    for name, tree in modules.items():
        explained = {"forward"} | methods(tree, of_protocols=True)
        explained |= explained_steps if name.startswith(("steps/", "benchmarks/")) else set()
        explained.update(*(of_bases(node, classes) for node in tree.body if isinstance(node, ast.ClassDef)))
        public = [kind for kind in tree.body if isinstance(kind, ast.ClassDef) and not kind.name.startswith("_")]
        for node in [one for kind in public for one in kind.body if isinstance(one, ast.FunctionDef)]:
            asks = ast.unparse(node.body[0]) == "..."  # of a protocol, which says what it asks for
            if not (node.name.startswith("_") or asks or ast.get_docstring(node) or node.name in explained):
                problems.append(f"{name}:{node.lineno}: {node.name} has no docstring")
    refuse(problems)


WORDS_THAT_DO_NOT_BELONG = re.compile(
    r"\b(sessions?|sub-?agents?|prompts?|colleagues?|the brief|the lead|chatbot|assistant|language model)\b"
    r"|/work/|/root/|/home/|\bissue #?\d|\bpart \d of the (task|job)\b",
    re.IGNORECASE,
)
SIMULATED = "sim simulate datasets simulator loop serve dataset sweeps returns sensor".split()
"""Folders and files that speak of a simulator's sessions."""


def test_product_text_speaks_to_users(repository: Path, package_dir: Path) -> None:
    kinds = (".py", ".cpp", ".h", ".hpp", ".md", ".json", ".yaml", ".cu")
    texts = [path for path in package_dir.rglob("*") if path.suffix in kinds]
    problems = []
    for path in sorted([*texts, *repository.glob("*.md"), *(repository / "docs").rglob("*.md")]):
        simulated = path.parent.name in SIMULATED or path.stem in SIMULATED  # ``sim.Session`` is what a user opens
        opened = r"(?i)\bsession\b" if simulated else r"sim[./][Ss]ession"
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if found := WORDS_THAT_DO_NOT_BELONG.search(re.sub(opened, "", line)):
                problems.append(f"{path.name}:{number}: {found.group(0)!r}: {line.strip()[:100]}")
    refuse(problems)


SHORT = test_files_and_functions_stay_short_and_take_few_parameters
MANY = ", ".join(f"a{n}" for n in range(MAX_PARAMETERS + 1))


@pytest.mark.parametrize(
    ("rule", "snippet"),
    [
        (test_nothing_executes_data, "import pickle\n"),
        (test_nothing_executes_data, "def f(x: int) -> int:\n    '''d'''\n    return eval('x')\n"),
        (test_nothing_executes_data, "import subprocess\nsubprocess.run('ls', shell=True)\n"),
        (test_outputs_are_kept_apart_from_inputs, "run = RunDir.open(out, OUTPUT, {}, {})\n"),
        (test_no_global_random_state, "import torch\ntorch.rand(3)\n"),
        (test_no_global_random_state, "import numpy as np\nnp.random.default_rng(0)\n"),
        (test_only_the_store_opens_files, "open('x', 'w')\n"),
        (test_only_the_store_opens_files, "path.open('ab')\n"),
        (test_only_the_store_opens_files, "path.write_text('x')\n"),
        (test_only_the_store_opens_files, "path.read_bytes()\n"),
        (test_only_the_store_opens_files, "Image.open(path)\n"),
        (test_only_the_store_opens_files, "yaml.safe_load(text)\n"),
        (test_public_methods_are_documented, "class Box:\n    def size(self) -> int:\n        return 1\n"),
        (test_torch_is_not_imported_where_help_must_be_fast, "import torch\n"),
        (SHORT, "x = 1\n" * (MAX_FILE_LINES + 1)),
        (SHORT, "def f():\n    'long'\n" + "    x = 1\n" * MAX_FUNCTION_LINES),
        (SHORT, f"def f({MANY}):\n    pass\n"),
        (test_class_names_are_unique, "class Table:\n    pass\n\n\nclass Table:\n    pass\n"),
        (test_no_import_cycles_even_late_ones, "def f():\n    from mudg.base import other\n"),
    ],
)
def test_each_rule_catches_its_offence(tmp_path: Path, rule: Callable[[Path], None], snippet: str) -> None:
    """A rule that cannot fail protects nothing: give each one a package that breaks it."""
    (tmp_path / "base").mkdir()
    for number in range(12):
        (tmp_path / "base" / f"fine{number}.py").write_text('"""Fine."""\n')
    (tmp_path / "base" / "other.py").write_text('"""Other."""\n\nfrom mudg.base import bad\n')
    rule(tmp_path)
    (tmp_path / "base" / "bad.py").write_text('"""Bad."""\n' + snippet)
    with pytest.raises(AssertionError):
        rule(tmp_path)
