"""House rules that a machine can check by reading the source. CONTRIBUTING.md says why each exists."""

from __future__ import annotations

import ast
import functools
import gc
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

MAX_FILE_LINES = 940
MAX_FUNCTION_LINES = 100  # without the docstring
MAX_PARAMETERS = 10  # without self and cls

# The rooms from the top down; an import may only reach a lower one, or its own.
ROOMS = (
    "__init__",
    "__main__",
    "app",
    "benchmarks",
    "steps",
    "datasets",
    "sim",
    "viewer",
    "fleet",
    "scoring",
    "exporting",
    "editing",
    "diffusion",
    "baselines",
    "gaussians",
    "labels",
    "formats",
    "city",
    "scene",
    "networks",
    "core",
    "native",
    "base",
)

# Modules that `mudg --help` loads, or that plain `import mudg` may reach: torch only inside functions.
TORCH_FREE = (
    "__init__.py",
    "__main__.py",
    "app.py",
    "steps/*.py",
    "*/settings.py",
    "*/settings/*.py",
    "*/*_settings.py",
    "benchmarks/step.py",
    "base/*.py",
)
TORCH_ALLOWED = ("base/checkpoint.py", "base/weights.py")

FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "random", "torchvision"}
LITERAL_TABLES = (
    "__init__.py",
    "formats/importers/__init__.py",
    "gaussians/model.py",
    "gaussians/recipes.py",
    "steps/__init__.py",
    "steps/step.py",
)
"""Files that import by names, all of which stand in a table beside."""
FORBIDDEN_CALLS = {
    "eval",
    "exec",
    "compile",
    "__import__",
    "os.system",
    "os.popen",
    "os.execv",
    "os.fork",
    "tempfile.mktemp",
    "yaml.load",
    "yaml.unsafe_load",
    "yaml.full_load",
    "torch.manual_seed",
    "torch.seed",
    "np.random.seed",
    "torch.jit.load",
    "np.load",
    "numpy.load",
    "torch.hub.load",
}
WRITERS = {
    "np.save",
    "np.savez",
    "np.savez_compressed",
    "np.savetxt",
    "torch.save",
    "json.dump",
    "yaml.dump",
    "save_file",
}
DRAWS = {
    "rand",
    "randn",
    "randint",
    "randperm",
    "normal",
    "bernoulli",
    "multinomial",
    "poisson",
    "rand_like",
    "randn_like",
}
IN_PLACE_DRAWS = {"normal_", "uniform_", "random_", "bernoulli_", "exponential_", "trunc_normal_"}


def sources(package_dir: Path) -> list[Path]:
    found = sorted(package_dir.rglob("*.py"))
    assert len(found) > 10, "the package's sources were not found"
    return found


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
    for path in sources(package_dir):
        yield path.relative_to(package_dir).as_posix(), syntax_of(path, path.stat().st_mtime_ns)


def dotted(node: ast.AST) -> str:
    """Return ``a.b.c`` for an attribute chain, '' for anything else."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    if isinstance(node, ast.Name):
        parts.append(node.id)
        return ".".join(reversed(parts))
    return ""


@functools.lru_cache(maxsize=4000)
def calls(tree: ast.AST) -> list[tuple[ast.Call, str]]:
    return [(node, dotted(node.func)) for node in walk(tree) if isinstance(node, ast.Call)]


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


def top_level_imports(tree: ast.Module) -> Iterator[tuple[int, str]]:
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom | ast.Try | ast.With):
            yield from imported_modules(node)


def refuse(problems: list[str]) -> None:
    assert not problems, "\n" + "\n".join(problems)


CONNECTS = {
    "socket",
    "ssl",
    "urllib.request",
    "http",
    "ftplib",
    "smtplib",
    "poplib",
    "imaplib",
    "telnetlib",
    "xmlrpc",
    "asyncio",
    "requests",
    "httpx",
    "aiohttp",
    "websockets",
    "paramiko",
    "fsspec",
    "s3fs",
    "gcsfs",
    "adlfs",
    "ray",
    "submitit",
    "torch.distributed",
    "torch.hub",
}
CONNECTING = {
    "base/location.py": {"fsspec", "ssl"},
    "fleet/engines.py": {"ray", "submitit"},
    "diffusion/parallel.py": {"torch.distributed"},
    "viewer/server.py": {"http"},
    "sim/server.py": {"http"},  # counts for Prometheus, on loopback; gRPC itself is grpcio
    "viewer/view.py": {"http"},
}
"""Modules that may reach a network, and what of. SECURITY.md tells when they do."""


def test_only_these_modules_can_open_a_connection(package_dir: Path, repository: Path) -> None:
    problems = []
    for name, tree in parsed(package_dir):
        for line, module in imported_modules(tree):
            kind = next((one for one in CONNECTS if module == one or module.startswith(f"{one}.")), None)
            if kind not in (None, "socket") and kind not in CONNECTING.get(name, ()):
                problems.append(f"{name}:{line}: imports {module}")
        problems += [
            f"{name}:{node.lineno}: socket.{node.attr}"
            for node in walk(tree)
            if isinstance(node, ast.Attribute)
            and dotted(node).startswith("socket.")
            and node.attr not in ("gethostname", "timeout")
            and not CONNECTING.get(name)
        ]
    refuse(problems)
    told = (repository / "SECURITY.md").read_text(encoding="utf-8")
    for word in ("s3://", "ray", "slurm", "torchrun", "mudg view", "credentials", "--token", "127.0.0.1"):
        assert word in told, word
    assert "No command opens a connection." not in told + (repository / "docs" / "architecture.md").read_text(
        encoding="utf-8"
    )


def test_imports_point_down(package_dir: Path) -> None:
    problems = []
    for name, tree in parsed(package_dir):
        own = name.split("/")[0].removesuffix(".py")
        if name == "__init__.py":
            continue  # the lazy names of the package root
        for line, module in imported_modules(tree):
            parts = module.split(".")
            if parts[0] != "mudg" or len(parts) < 2:
                continue
            other = parts[1] if parts[1] in ROOMS else "__init__"
            if parts[1] != "__version__" and ROOMS.index(other) < ROOMS.index(own):
                problems.append(f"{name}:{line}: {own} imports {module}, which lies above it")
    refuse(problems)


def test_torch_is_not_imported_where_help_must_be_fast(package_dir: Path) -> None:
    allowed = {package_dir / name for name in TORCH_ALLOWED}
    listed = sorted({path for pattern in TORCH_FREE for path in package_dir.glob(pattern)} - allowed)
    assert listed
    problems = []
    for path in listed:
        for line, module in top_level_imports(ast.parse(path.read_text(encoding="utf-8"))):
            if module.split(".")[0] in ("torch", "scipy", "av"):
                problems.append(f"{path.relative_to(package_dir)}:{line}: imports {module} at the top")
    refuse(problems)


def test_nothing_executes_data(package_dir: Path) -> None:
    problems = []
    for name, tree in parsed(package_dir):
        problems += [
            f"{name}:{line}: imports {module}"
            for line, module in imported_modules(tree)
            if module.split(".")[0] in FORBIDDEN_MODULES
        ]
        for call, function in calls(tree):
            if function in FORBIDDEN_CALLS:
                problems.append(f"{name}:{call.lineno}: calls {function}")
            if function == "torch.load" and name != "base/weights.py":
                problems.append(f"{name}:{call.lineno}: torch.load belongs to base/weights.py alone")
            computed = function.endswith(("import_module", "resolve_name")) and not isinstance(
                call.args[0], ast.Constant
            )
            if computed and name not in LITERAL_TABLES:
                problems.append(f"{name}:{call.lineno}: a computed name becomes an import")
            for keyword in call.keywords:
                value = keyword.value.value if isinstance(keyword.value, ast.Constant) else None
                if (keyword.arg in ("shell", "allow_pickle") and value is not False) or (
                    keyword.arg in ("weights_only", "verify") and value is False
                ):
                    problems.append(f"{name}:{call.lineno}: {keyword.arg}={ast.unparse(keyword.value)}")
    refuse(problems)


def test_only_the_store_opens_files_for_writing(package_dir: Path) -> None:
    problems = []
    for name, tree in parsed(package_dir):
        if name == "base/store.py":
            continue
        for call, function in calls(tree):
            method = call.func.attr if isinstance(call.func, ast.Attribute) else ""
            if function == "open" or method == "open":
                modes = [a.value for a in call.args[:2] if isinstance(a, ast.Constant) and isinstance(a.value, str)]
                modes += [k.value.value for k in call.keywords if k.arg == "mode" and isinstance(k.value, ast.Constant)]
                writes = any(re.fullmatch(r"[rbt]*[wax+][rwabtx+]*", str(mode)) for mode in modes)
                if writes and function != "av.open":
                    problems.append(f"{name}:{call.lineno}: opens a file for writing")
            if method in ("write_text", "write_bytes") and not dotted(call.func).startswith("store."):
                problems.append(f"{name}:{call.lineno}: {ast.unparse(call.func)}")
            if function in WRITERS:
                problems.append(f"{name}:{call.lineno}: {function} writes without the store")
    refuse(problems)


READS_OF_OTHERS = {"base/memory.py", "base/processes.py", "native/__init__.py", "steps/step.py", "viewer/page.py"}
"""Files that read what the system, or this package itself, provides."""


def test_only_the_store_opens_files_for_reading(package_dir: Path) -> None:
    """Where a file should be, a pipe or a device may lie; only the store looks before it opens. And YAML is bounded in
    one place."""
    problems = []
    for name, tree in parsed(package_dir):
        for call, function in calls(tree):
            method = call.func.attr if isinstance(call.func, ast.Attribute) else ""
            if (
                function in ("yaml.safe_load", "yaml.load", "yaml.compose", "yaml.parse", "yaml.scan")
                and name != "base/plain_yaml.py"
            ):
                problems.append(f"{name}:{call.lineno}: {function} without bounds")
            if name == "base/store.py" or name in READS_OF_OTHERS:
                continue
            modes = [a.value for a in call.args[:2] if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            given = [a for a in call.args[:1] if not isinstance(a, ast.Constant)]
            if (function == "open" or method == "open") and any(re.fullmatch(r"[rbt]+", mode) for mode in modes):
                problems.append(f"{name}:{call.lineno}: opens a file")
            if method in ("read_text", "read_bytes") and not dotted(call.func).startswith("store."):
                problems.append(f"{name}:{call.lineno}: {ast.unparse(call.func)}")
            if function == "Image.open" and given and not ast.unparse(given[0]).startswith("io.BytesIO"):
                problems.append(f"{name}:{call.lineno}: opens a picture by its name")
            if function.endswith("safe_open") and "store.regular" not in ast.unparse(call):
                problems.append(f"{name}:{call.lineno}: opens a file by its name")
    refuse(problems)


def test_outputs_are_kept_apart_from_inputs(package_dir: Path) -> None:
    """A verb's folder is opened after its inputs were compared with it; two open folders of their own results."""
    problems = []
    for name, tree in parsed(package_dir):
        opened = [call.lineno for call, function in calls(tree) if function.endswith("RunDir.open")]
        compared = [
            call.lineno for call, function in calls(tree) if function.endswith(("refuse_overlap", "_refuse_overlap"))
        ]
        if len(compared) < len(opened) and name not in ("benchmarks/cities.py", "diffusion/city_clips.py"):
            problems.append(f"{name}:{opened[0]}: RunDir.open without refuse_overlap")
    refuse(problems)


def test_no_global_random_state(package_dir: Path) -> None:
    problems = []
    for name, tree in parsed(package_dir):
        if name == "base/seeds.py":
            continue
        for call, function in calls(tree):
            named = {keyword.arg for keyword in call.keywords}
            parts = function.split(".")
            if parts[0] == "torch" and parts[-1] in DRAWS and len(parts) == 2 and "generator" not in named:
                problems.append(f"{name}:{call.lineno}: {function} without generator=")
            method = call.func.attr if isinstance(call.func, ast.Attribute) else ""
            if method in IN_PLACE_DRAWS and "generator" not in named:
                problems.append(f"{name}:{call.lineno}: {method} without generator=")
            if function.startswith(("np.random.", "numpy.random.")):
                problems.append(f"{name}:{call.lineno}: {function}: draw from mudg.base.seeds")
    refuse(problems)


def test_no_blind_except(package_dir: Path) -> None:
    problems = []
    for name, tree in parsed(package_dir):
        for node in walk(tree):
            if not isinstance(node, ast.ExceptHandler):
                continue
            kinds = node.type.elts if isinstance(node.type, ast.Tuple) else [node.type]
            blind = any(kind is None or dotted(kind) in ("Exception", "BaseException") for kind in kinds)
            if blind and not any(isinstance(inner, ast.Raise) for inner in ast.walk(node)):
                problems.append(f"{name}:{node.lineno}: catches everything and does not raise")
    refuse(problems)


def length_without_docstring(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    length = (node.end_lineno or node.lineno) - node.lineno + 1
    first = node.body[0]
    if ast.get_docstring(node, clean=False) is not None:
        length -= (first.end_lineno or first.lineno) - first.lineno + 1
    return length


def test_files_and_functions_stay_short(package_dir: Path) -> None:
    problems = []
    for path in sources(package_dir):
        lines = path.read_text(encoding="utf-8").count("\n")
        if lines > MAX_FILE_LINES:
            problems.append(f"{path.relative_to(package_dir)}: {lines} lines")
    for name, tree in parsed(package_dir):
        for node in walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = length_without_docstring(node)
                if length > MAX_FUNCTION_LINES:
                    problems.append(f"{name}:{node.lineno}: {node.name} has {length} lines")
    refuse(problems)


def test_functions_take_few_parameters(package_dir: Path) -> None:
    problems = []
    for name, tree in parsed(package_dir):
        for node in walk(tree):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            count = sum(argument.arg not in ("self", "cls", "ctx") for argument in every)
            if count > MAX_PARAMETERS:
                problems.append(
                    f"{name}:{node.lineno}: {node.name} takes {count} parameters; make a frozen dataclass of them"
                )
    refuse(problems)


def test_class_names_are_unique(package_dir: Path) -> None:
    """A name that two classes share cannot be searched for."""
    homes: dict[str, list[str]] = {}
    for name, tree in parsed(package_dir):
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(f"{name}:{node.lineno}")
    refuse([f"{name}: {', '.join(places)}" for name, places in sorted(homes.items()) if len(places) > 1])


def module_imports(package_dir: Path) -> dict[str, set[str]]:
    """Module -> modules of the package that it imports anywhere, late imports included, type-checking ones left out."""
    modules = {}
    for path in sources(package_dir):
        dotted_name = (
            path.relative_to(package_dir)
            .with_suffix("")
            .as_posix()
            .replace("/", ".")
            .removesuffix("__init__")
            .rstrip(".")
        )
        modules[f"mudg.{dotted_name}".rstrip(".")] = path
    found: dict[str, set[str]] = {}
    for module, path in modules.items():
        reached = set()
        for _, imported in imported_modules(syntax_of(path, path.stat().st_mtime_ns)):
            while imported and imported not in modules:
                imported = imported.rpartition(".")[0]
            if imported not in ("", "mudg", module):
                reached.add(imported)
        found[module] = reached
    found.pop("mudg", None)  # the lazy names of the package root
    return found


def cycles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that reach each other (Tarjan's strongly connected components of more than one module)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    groups: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(graph.get(node, ())):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = []
            while not group or group[-1] != node:
                group.append(stack.pop())
            if len(group) > 1:
                groups.append(sorted(group))

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return groups


def test_no_import_cycles_even_late_ones(package_dir: Path) -> None:
    refuse([" <-> ".join(group) for group in cycles(module_imports(package_dir))])


def public_definitions(tree: ast.Module) -> Iterator[tuple[ast.FunctionDef | ast.ClassDef, bool]]:
    """Yield (definition, is a method) of the public functions, classes and methods of one module."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node, False
            if isinstance(node, ast.ClassDef):
                for inner in node.body:
                    if isinstance(inner, ast.FunctionDef) and not inner.name.startswith("_"):
                        yield inner, True


def explained_once(tree: ast.Module) -> set[str]:
    """Methods that need no text of their own: torch's forward, and what a Protocol in the same module explains."""
    names = {"forward"}
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and any(dotted(base) == "Protocol" for base in node.bases):
            names |= {m.name for m in node.body if isinstance(m, ast.FunctionDef) and ast.get_docstring(m)}
    return names


STEP_METHODS = {
    "act",
    "answer",
    "applies",
    "checked",
    "inputs",
    "is_file",
    "key_settings",
    "make",
    "output",
    "places",
    "prepare",
    "reads",
    "required",
    "resulting",
    "run_parts",
    "settings_in_list",
    "verb",
}
"""What every verb has: explained in `Step` and `Result`."""


def test_public_functions_are_annotated_and_documented(package_dir: Path) -> None:
    problems = []
    for name, tree in parsed(package_dir):
        for node, is_method in public_definitions(tree):
            if node.name == "main" and name == "__main__.py":
                continue
            explained = explained_once(tree) | (STEP_METHODS if name.startswith(("steps/", "benchmarks/")) else set())
            if isinstance(node, ast.FunctionDef) and ast.unparse(node.body[0]) == "...":
                continue  # of a protocol, whose text says what it asks for
            if not ast.get_docstring(node) and not (is_method and node.name in explained):
                problems.append(f"{name}:{node.lineno}: {node.name} has no docstring")
            if isinstance(node, ast.ClassDef):
                continue
            arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            skip = 1 if is_method and not any(dotted(d) == "staticmethod" for d in node.decorator_list) else 0
            bare = [a.arg for a in arguments[skip:] if a.annotation is None]
            if bare or node.returns is None:
                problems.append(f"{name}:{node.lineno}: {node.name} lacks annotations ({', '.join(bare) or 'return'})")
        if not ast.get_docstring(tree):
            problems.append(f"{name}: no module docstring")
    refuse(problems)


def test_no_print_in_the_library(package_dir: Path) -> None:
    refuse(
        [
            f"{name}:{call.lineno}: print"
            for name, tree in parsed(package_dir)
            for call, f in calls(tree)
            if f == "print"
        ]
    )


def test_class_names_say_what_a_thing_is(package_dir: Path) -> None:
    vague = re.compile(r"(Manager|Helper|Utils?|Trainer|Handler|^Base[A-Z]\w*)$")
    refuse(
        [
            f"{name}:{node.lineno}: {node.name}"
            for name, tree in parsed(package_dir)
            for node in walk(tree)
            if isinstance(node, ast.ClassDef) and vague.search(node.name)
        ]
    )


WORDS_THAT_DO_NOT_BELONG = re.compile(
    r"\b(sessions?|sub-?agents?|prompts?|colleagues?|the brief|the lead|chatbot|assistant|language model)\b"
    r"|/work/|/root/|/home/|\bissue #?\d|\bpart \d of the (task|job)\b",
    re.IGNORECASE,
)


def product_texts(repository: Path, package_dir: Path) -> list[Path]:
    kinds = (".py", ".cpp", ".h", ".hpp", ".md", ".json", ".yaml", ".cu")
    texts = [p for p in package_dir.rglob("*") if p.suffix in kinds]
    texts += [*repository.glob("*.md"), *(repository / "docs").rglob("*.md")]
    return sorted(texts)


SIMULATED = ("sim", "simulate", "datasets", "simulator", "loop", "serve", "dataset", "sweeps", "returns", "sensor")
"""Folders and files that speak of a simulator's sessions."""


def test_product_text_speaks_to_users(repository: Path, package_dir: Path) -> None:
    problems = []
    for path in product_texts(repository, package_dir):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            simulated = path.parent.name in SIMULATED or path.stem in SIMULATED  # ``sim.Session`` is what a user opens
            found = WORDS_THAT_DO_NOT_BELONG.search(
                re.sub(r"(?i)\bsession\b" if simulated else r"sim[./][Ss]ession", "", line)
            )
            if found:
                problems.append(f"{path.name}:{number}: {found.group(0)!r}: {line.strip()[:100]}")
    refuse(problems)


@pytest.mark.parametrize(
    ("snippet", "test"),
    [
        ("def f():\n    try:\n        pass\n    except Exception:\n        pass\n", test_no_blind_except),
        ("import pickle\n", test_nothing_executes_data),
        ("def f(x: int) -> int:\n    '''d'''\n    return eval('x')\n", test_nothing_executes_data),
        ("import subprocess\nsubprocess.run('ls', shell=True)\n", test_nothing_executes_data),
        ("run = RunDir.open(out, OUTPUT, {}, {})\n", test_outputs_are_kept_apart_from_inputs),
        ("import torch\ntorch.rand(3)\n", test_no_global_random_state),
        ("import numpy as np\nnp.random.default_rng(0)\n", test_no_global_random_state),
        ("open('x', 'w')\n", test_only_the_store_opens_files_for_writing),
        ("path.open('ab')\n", test_only_the_store_opens_files_for_writing),
        ("path.write_text('x')\n", test_only_the_store_opens_files_for_writing),
        ("path.read_bytes()\n", test_only_the_store_opens_files_for_reading),
        ("Image.open(path)\n", test_only_the_store_opens_files_for_reading),
        ("yaml.compose(text)\n", test_only_the_store_opens_files_for_reading),
        ("yaml.safe_load(text)\n", test_only_the_store_opens_files_for_reading),
        ("print(1)\n", test_no_print_in_the_library),
        ("def f(x):\n    return x\n", test_public_functions_are_annotated_and_documented),
        ("class SceneManager:\n    '''d'''\n", test_class_names_say_what_a_thing_is),
        ("from mudg.stages import fit\n", test_imports_point_down),
        ("import torch\n", test_torch_is_not_imported_where_help_must_be_fast),
        ("x = 1\n" * (MAX_FILE_LINES + 1), test_files_and_functions_stay_short),
        ("def f():\n    'long'\n" + "    x = 1\n" * MAX_FUNCTION_LINES, test_files_and_functions_stay_short),
        (
            f"def f({', '.join(f'a{n}' for n in range(MAX_PARAMETERS + 1))}):\n    pass\n",
            test_functions_take_few_parameters,
        ),
        ("class Table:\n    pass\n\n\nclass Table:\n    pass\n", test_class_names_are_unique),
        ("def f():\n    from mudg.base import other\n", test_no_import_cycles_even_late_ones),
    ],
)
def test_each_rule_catches_its_offence(tmp_path: Path, snippet: str, test: object) -> None:
    """A rule that cannot fail protects nothing: give each one a package that breaks it."""
    (tmp_path / "base").mkdir()
    for number in range(12):
        (tmp_path / "base" / f"fine{number}.py").write_text('"""Fine."""\n')
    (tmp_path / "base" / "other.py").write_text('"""Other."""\n\nfrom mudg.base import bad\n')
    test(tmp_path)
    (tmp_path / "base" / "bad.py").write_text('"""Bad."""\n' + snippet)
    with pytest.raises(AssertionError):
        test(tmp_path)
