"""The tensors of a TorchScript archive, read without running its program."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path

import pytest
import torch
from refusals import Asks, refused

from mudg.base.weights import is_torchscript, read_checkpoint, read_torchscript

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")


class Inner(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.branch_0 = torch.nn.Conv2d(2, 3, 1)
        self.register_buffer("count", torch.tensor(7))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.branch_0(x) * self.count


class Outer(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.mixed = torch.nn.Sequential(Inner(), torch.nn.BatchNorm2d(3))
        self.turned = torch.nn.Parameter(torch.arange(6.0).reshape(2, 3).T)
        self.narrow = torch.nn.Parameter(torch.arange(3.0).half(), requires_grad=False)
        self.rate = 0.5

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.mixed(x)


@pytest.fixture
def archive(tmp_path: Path) -> tuple[Path, Outer]:
    module = Outer().eval()
    torch.jit.save(torch.jit.script(module), tmp_path / "network.pt")
    return tmp_path / "network.pt", module


def test_names_and_values_are_those_of_the_module(archive: tuple[Path, Outer]) -> None:
    path, module = archive
    assert is_torchscript(path)
    found = read_torchscript(path)
    wanted = module.state_dict()
    assert set(found) == set(wanted)
    for name, value in wanted.items():
        assert found[name].dtype == value.dtype and torch.equal(found[name], value), name
    assert set(read_checkpoint(path)) == set(wanted)


def test_other_files_are_no_archives(tmp_path: Path) -> None:
    torch.save({"a": torch.zeros(1)}, tmp_path / "state.pth")
    assert not is_torchscript(tmp_path / "state.pth")
    assert torch.equal(read_checkpoint(tmp_path / "state.pth")["a"], torch.zeros(1))


def rewritten(path: Path, change) -> Path:
    """The archive with changed members: ``change(name, content)``."""
    target = path.with_name("changed.pt")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            new.writestr(name, change(name, old.read(name)))
    return target


def test_what_no_network_needs_is_refused(archive: tuple[Path, Outer], capsys: pytest.CaptureFixture[str]) -> None:
    evil = pickle.dumps(Asks(print, "ran"), 2)
    path = rewritten(archive[0], lambda name, old: evil if name.endswith("/data.pkl") else old)
    refused("print", read_torchscript, path)
    assert capsys.readouterr().out == ""


def test_damaged_archives_are_refused(archive: tuple[Path, Outer]) -> None:
    short = rewritten(archive[0], lambda name, old: old[:-4] if "/data/" in name else old)
    refused("does not fit its storage", read_torchscript, short)
    cut = rewritten(archive[0], lambda name, old: old[:50] if name.endswith("/data.pkl") else old)
    refused(".", read_torchscript, cut)
