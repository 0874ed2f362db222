"""What every test gets: one thread, no network, real data where it lies beside the checkout."""

from __future__ import annotations

import gc
import os
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Set before any test imports torch: tests are many and small, workers share the cores, and results must not depend on
# their number.
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MUDG_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("NO_COLOR", "1")
os.environ.setdefault("COLUMNS", "120")

ALIKE = {"deadline": None, "derandomize": True, "max_examples": 25, "database": None}
settings.register_profile("mudg", **ALIKE, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("mudg")

REPOSITORY = Path(__file__).resolve().parents[1]


def pytest_collection_finish() -> None:
    """What collecting has made stays to the end: the garbage collector need not look at it again."""
    gc.freeze()


def pytest_report_header() -> list[str]:
    """Say which mudg is under test: the installed one, or the source tree."""
    import mudg

    home = Path(mudg.__file__).resolve().parent
    kind = "source tree" if home.is_relative_to(REPOSITORY / "src") else "installed"
    return [f"mudg {mudg.__version__} ({kind}): {home}"]


@pytest.fixture(scope="session")
def repository() -> Path:
    """The checkout the tests lie in."""
    return REPOSITORY


@pytest.fixture(scope="session")
def package_dir() -> Path:
    """The folder of the mudg package under test."""
    import mudg

    return Path(mudg.__file__).resolve().parent


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """Return ``find(name) -> Path``: a folder of real driving data, or skip the test where there is none."""

    def find(name: str) -> Path:
        root = Path(os.environ.get("MUDG_SHARED_DATA", REPOSITORY.parent / "shared" / "data"))
        path = root / name
        if not path.exists():
            pytest.skip(f"real data {name!r} is not on this machine (set MUDG_SHARED_DATA)")
        return path

    return find


@pytest.fixture(scope="session")
def street_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like that of ``mudg run``: a street of four frames, its clouds, and a fit. Tests leave it as it is."""
    from fit_settings import fit_config
    from toy_world import fused_cloud, write_scene

    from mudg.scene.clouds import write_fused
    from mudg.steps.fit import Fit

    root = tmp_path_factory.mktemp("log") / "street"
    write_scene(root / "scene", frames=4, cameras=("front",), width=60, height=40)
    write_fused(root / "fuse", fused_cloud(4), {"tracks": {"car": {"moving": True}}})
    config = fit_config(method="street_gaussians", iterations=60, start__gaussians=900, densify__max_gaussians=1500)
    Fit(scene=root / "scene", fused=root / "fuse", out=root / "fit" / "street_gaussians", settings=config).run()
    return root


@pytest.fixture(params=["avx512", "avx2", "portable"])
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Every instruction set of the native library that can run here, one after the other."""
    from mudg import native
    from mudg.base.errors import ResourceError, UsageError

    try:
        native.set_isa(request.param)
    except (UsageError, ResourceError) as error:
        pytest.skip(str(error))
    yield request.param
    native.set_isa("")


@pytest.fixture
def set_threads() -> Iterator[Callable[[int], None]]:
    """Sets the threads of the native library, until the test ends; skips the test where there is no library."""
    from mudg import native

    if native.library() is None:
        pytest.skip(native.status())
    before = native.threads()
    yield native.set_threads
    native.set_threads(before)


@pytest.fixture(autouse=True, scope="session")
def _no_network() -> Iterator[None]:
    """Refuse every connection except to this machine."""
    connect = socket.socket.connect

    def guarded(self: socket.socket, address: object) -> object:
        local = self.family not in (socket.AF_INET, socket.AF_INET6)
        if not local and isinstance(address, tuple) and address[0] not in ("127.0.0.1", "::1", "localhost"):
            raise RuntimeError(f"a test tried to reach the network: {address}")
        return connect(self, address)

    socket.socket.connect = guarded
    yield
    socket.socket.connect = connect


@pytest.fixture(autouse=True, scope="session")
def _no_waiting_for_the_disk() -> Iterator[None]:
    """No test cuts the power: what the system has taken is read back, also by other processes and after a kill."""
    before = os.fsync, os.sync
    os.fsync, os.sync = (lambda _fd: None), (lambda: None)
    yield
    os.fsync, os.sync = before


@pytest.fixture(autouse=True)
def _one_torch_thread() -> Iterator[None]:
    """Give back the thread count a test may have changed, if torch is loaded at all."""
    torch = sys.modules.get("torch")
    before = torch.get_num_threads() if torch is not None else None
    yield
    if torch is not None and torch.get_num_threads() != before:
        torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def _loud() -> Iterator[None]:
    """What a command with --quiet has switched off in this process is on again for the next test."""
    yield
    log = sys.modules.get("mudg.base.log")
    if log is not None:
        log.set_quiet(False)
