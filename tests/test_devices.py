"""`--device`: what is chosen, what is refused and how; and the pretend device that the other tests compute on."""

import pytest
import torch
from pretend_device import DEVICE, Pretend, pretend_device

from mudg.base import devices, log
from mudg.base.errors import ResourceError, UsageError


@pytest.fixture
def said(monkeypatch):
    lines: list[str] = []
    monkeypatch.setattr(log, "info_once", lines.append)
    return lines


def test_an_explicit_device_is_never_replaced_and_auto_is_the_cpu_without_cuda(monkeypatch, said):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert devices.choose_device("auto", "fit") == torch.device("cpu") and said == ["fit: on the CPU"]
    for name in ("cuda", "cuda:0"):
        with pytest.raises(ResourceError, match="--device"):
            devices.choose_device(name, "fit")


def test_auto_is_the_first_cuda_device_and_says_its_name_and_memory(monkeypatch, said):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (10 * 2**30, 24 * 2**30))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Card")
    assert devices.choose_device("auto", "fit") == torch.device("cuda", 0)
    assert said == ["fit: on cuda:0 (Card, 10.0 of 24.0 GiB free)"]
    assert devices.choose_device("cuda:1", "fit") == torch.device("cuda", 1)
    assert devices.choose_device("auto", "labels", kinds=("cpu",)) == torch.device("cpu")
    with pytest.raises(ResourceError, match="cuda:0 to cuda:1"):
        devices.choose_device("cuda:2", "fit")


@pytest.mark.parametrize("name", ["gpu", "cuda:x", "", "cuda:-1", "AUTO", "mps"])
def test_unknown_devices_and_those_without_an_implementation_are_refused_with_the_known_ones(name):
    with pytest.raises(UsageError, match=r"auto, cpu, cuda" if name != "mps" else "fit: not implemented"):
        devices.choose_device(name, "fit")


def test_memory_of_a_device_that_runs_out_is_an_error_with_a_remedy():
    def fill():
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has a total")

    with (
        pytest.raises(ResourceError, match=r"fit: the memory of cuda:1 ran out[\s\S]*--width-px"),
        devices.memory_of(torch.device("cuda", 1), "fit"),
    ):
        fill()


def test_the_pretend_device_refuses_what_a_gpu_refuses():
    with pretend_device() as there:
        assert devices.choose_device("pretend", "fit") == there
        a = torch.ones(3).to(there)
        assert a.device == DEVICE and isinstance(a, Pretend)
        for slip in (
            lambda: a + torch.ones(3),
            a.numpy,
            a.data_ptr,
            lambda: torch.randn(3, device=there, generator=torch.Generator()),
        ):
            with pytest.raises((RuntimeError, TypeError)):
                slip()
        assert (a + 1).cpu().tolist() == [2.0, 2.0, 2.0] and (a * a).sum().item() == 3.0
