"""Operators of torch's graphs, exported as ONNX: read, the same numbers, bounded soundly; and what is refused."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from onnx_files import OnnxFile, attack, image_sets, session
from torch import Tensor, nn
from torch.nn import functional

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import bound_outputs, load_network
from ns_abstract.verify.network.graph import Network

SHAPE = (3, 8, 8)


class Behind(nn.Module):
    """A function behind a convolution, with constants to use."""

    k: Tensor

    def __init__(self, function: Callable[[Behind, Tensor], Tensor]) -> None:
        super().__init__()
        self.function, self.first = function, nn.Conv2d(3, 4, 3, 1, 1)
        self.w = nn.Parameter(torch.randn(4, 4))
        self.register_buffer("k", torch.tensor([2, 0, 1, 3]))
        self.line, self.turned = nn.Conv1d(4, 4, 3, 2, 1), nn.ConvTranspose1d(4, 2, 3, 2, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.function(self, self.first(x)).flatten(1)


class Attention(nn.Module):
    """Torch's own, with the batch first or behind the places, and a norm and a residual sum."""

    def __init__(self, first: bool) -> None:
        super().__init__()
        self.attention, self.first = nn.MultiheadAttention(6, 2, batch_first=first), first
        self.norm = nn.LayerNorm(6)

    def forward(self, x: Tensor) -> Tensor:
        places = x.reshape(x.shape[0], -1, 6)[:, :5]
        places = places if self.first else places.transpose(0, 1)
        found = places + self.attention(places, places, places, need_weights=False)[0]
        found = self.norm(found) + 0.5
        return (found if self.first else found.transpose(0, 1)).flatten(1)


def causal(m: Behind, y: Tensor) -> Tensor:
    """Heads as vision transformers have them: the batch moves inside and out again."""
    places = y.flatten(2).transpose(1, 2)[:, :12]
    three = torch.stack([places, places * 0.7, places + 0.1], 1).reshape(-1, 3, 12, 2, 2).permute(1, 0, 3, 2, 4)
    query, key, value = three.unbind(0)
    return functional.scaled_dot_product_attention(query, key, value, is_causal=True).transpose(1, 2)


def masked(m: Behind, y: Tensor) -> Tensor:
    places = y.flatten(2).transpose(1, 2)[:, None, :10]
    mask = torch.zeros(10, 10).masked_fill(torch.ones(10, 10).triu(1) > 0, float("-inf"))
    return functional.scaled_dot_product_attention(places, places, places, attn_mask=mask)


def token(m: Behind, y: Tensor) -> Tensor:
    return torch.cat([m.w[None, :1].expand(y.shape[0], -1, -1), y.flatten(2).transpose(1, 2)], 1)


def product(m: Behind, y: Tensor) -> Tensor:
    left, right = y.flatten(2)[:, :, :6], y.flatten(2)[:, :, 6:10].transpose(1, 2).repeat(1, 2, 1)[:, :6]
    return torch.bmm(left, right)


FUNCTIONS: dict[str, Callable[[Behind, Tensor], Tensor]] = {
    "adaptive pool": lambda m, y: functional.adaptive_avg_pool2d(y, 3),
    "adaptive pool of a line": lambda m, y: functional.adaptive_avg_pool1d(y.flatten(2), 5),
    "addcmul": lambda m, y: torch.addcmul(m.w[0][None, :, None, None], m.w[1][None, :, None, None], y),
    "attention with a mask": masked,
    "average pool of a line": lambda m, y: functional.avg_pool1d(y.flatten(2), 2),
    "bmm": product,
    "causal attention": causal,
    "channel shuffle": lambda m, y: functional.channel_shuffle(y, 2),
    "circular pad": lambda m, y: functional.pad(y, (1, 2, 1, 0), mode="circular"),
    "class token": token,
    "convolution of a line": lambda m, y: m.line(y.flatten(2)),
    "convolution of a line, transposed": lambda m, y: m.turned(y.flatten(2)[:, :, :7]),
    "cubic resizing": lambda m, y: functional.interpolate(y, size=5, mode="bicubic"),
    "diagonal": lambda m, y: torch.diagonal(y, 0, 2, 3),
    "einsum": lambda m, y: torch.einsum("bchw,cd->bhdw", y, m.w),
    "einsum of two": lambda m, y: torch.einsum("bchw,bcgw->bhg", y[:, :, :3], y[:, :, 3:5]),
    "GLU": lambda m, y: functional.glu(y, 1),
    "index": lambda m, y: y[:, m.k],
    "index_select": lambda m, y: torch.index_select(y, 2, m.k),
    "masked fill": lambda m, y: y.masked_fill(m.k[:, None, None] > 2, 0.25),
    "matrix from the left": lambda m, y: m.w @ y[:, :, :4],
    "matrix of channels": lambda m, y: y.movedim(1, 3) @ m.w,
    "max pool of a line": lambda m, y: functional.max_pool1d(y.flatten(2), 3, 2, 1),
    "normalised": lambda m, y: functional.normalize(y + 3.0, dim=1),
    "repeat": lambda m, y: y.repeat(1, 2, 1, 1),
    "roll": lambda m, y: torch.roll(y, (1, 2), (2, 3))[:, :, ::2],
    "rot90": lambda m, y: torch.rot90(y, 1, (2, 3)),
    "soft shrink": lambda m, y: functional.softshrink(y, 0.2),
    "squeezed batch": lambda m, y: y.mean(1, keepdim=True).squeeze().unsqueeze(0),
    "stack": lambda m, y: torch.stack([y, torch.relu(y)], 2),
    "standard deviation": lambda m, y: (y + torch.arange(4.0)[None, :, None, None] * 4).std(1),
    "threshold": lambda m, y: functional.threshold(y, 0.1, 0.1),
    "tile": lambda m, y: torch.tile(y, (1, 1, 2, 1))[:, :, 5:12],
    "unfold": lambda m, y: functional.unfold(y, 3, padding=1, stride=3),
    "unshuffle": lambda m, y: functional.pixel_unshuffle(y, 2),
    "variance": lambda m, y: y.var(dim=(2, 3), unbiased=False),
    "where": lambda m, y: torch.where(m.k[None, :, None, None] > 1, y, -0.5),
}
MODULES: dict[str, Callable[[], nn.Module]] = {
    **{name: (lambda f=f: Behind(f)) for name, f in FUNCTIONS.items()},
    "torch's attention": lambda: Attention(True),
    "torch's attention, places first": lambda: Attention(False),
}


def written(module: nn.Module, file: Path) -> Path:
    """By torch's exporter."""
    pytest.importorskip("onnxscript", reason="torch's exporter needs onnxscript")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(module.eval(), (torch.randn(1, *SHAPE),), str(file), dynamo=True, verbose=False)
    return file


def read(file: Path) -> Network:
    """The network; it must be read, and give what torch gives, which loading compares."""
    try:
        return load_network(file)
    except InputError as error:
        raise AssertionError(str(error)) from None


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_operators_are_read_and_bounded(name: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    module = MODULES[name]().eval()
    file = written(module, tmp_path / "net.onnx")
    network = read(file)

    def run(images: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return np.concatenate([module(torch.from_numpy(image[None])).numpy().reshape(1, -1) for image in images])

    x = np.random.default_rng(0).normal(size=(2, *SHAPE)).astype(np.float32)
    np.testing.assert_allclose(network(torch.from_numpy(x)).numpy().reshape(2, -1), run(x), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(session(file)(x[:1]).reshape(-1), run(x[:1])[0], rtol=1e-5, atol=1e-6)
    rows = np.random.default_rng(0).normal(size=(2, network.output_size))
    images = image_sets(SHAPE, 1, 2, 0.01, 0.005)
    least, _ = attack(network, run, images, 0, rows, 16, 3)
    lower = bound_outputs(network, images, rows, np.zeros(2)).lower[0]
    assert (lower <= least).all() and np.isfinite(lower).all()


REFUSED: dict[str, tuple[Callable[[Behind, Tensor], Tensor], str]] = {
    "jump": (lambda m, y: functional.threshold(y, 0.1, 0.0), "instead of a choice"),
    "mask of the image": (lambda m, y: y * (y > 0.0), "depends on|not known"),
    "numbers that are none": (lambda m, y: y + torch.full((1,), float("inf")), "not finite"),
    "cosine": (lambda m, y: torch.cos(y), "only constants may pass it"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_read_is_told(name: str, tmp_path: Path) -> None:
    function, message = REFUSED[name]
    with pytest.raises(InputError, match=message) as caught:
        load_network(written(Behind(function), tmp_path / "net.onnx"))
    assert caught.value.field is not None and caught.value.fix


@pytest.mark.slow
def test_a_program_of_torch_becomes_a_network_as_the_refusal_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnxscript", reason="torch's exporter needs onnxscript")
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    module = Attention(True).eval()
    torch.export.save(torch.export.export(module, (torch.randn(1, *SHAPE),)), "a net.pt2")
    with pytest.raises(InputError, match="has the ending") as caught:
        load_network(Path("a net.pt2"))
    assert caught.value.fix is not None
    first, second = caught.value.fix.removeprefix("convert it in Python: ").split("; ")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exec(f"{first}\n{second}", {"torch": torch})
    x = torch.randn(2, *SHAPE)
    with torch.no_grad():
        torch.testing.assert_close(load_network(Path("a net.onnx"))(x).float(), module(x), rtol=1e-4, atol=1e-5)


CHOICES = {
    "greater": ("Greater", "y", "c", np.maximum),
    "at least": ("GreaterOrEqual", "y", "c", np.maximum),
    "less": ("Less", "c", "y", np.maximum),
    "at most": ("LessOrEqual", "c", "y", np.maximum),
    "cut from above": ("Greater", "c", "y", np.minimum),
    "cut from above, at most": ("LessOrEqual", "y", "c", np.minimum),
    "above a limit": ("Greater", "y - c", "0", lambda y, c: np.maximum(y - c, 0)),
    "not below a limit": ("Less", "0", "y - c", lambda y, c: np.maximum(y - c, 0)),
    "below a limit": ("LessOrEqual", "y - c", "0", lambda y, c: np.minimum(y - c, 0)),
}


def chosen(file: Path, compare: str, then: str, other: str, limit: float = -0.3) -> Path:
    """y = 3 x, and a choice by y and a limit."""
    f = OnnxFile(SHAPE)
    f.node("Mul", f.last, f.constant(np.float32(3.0)))
    names = {"y": f.last, "c": f.constant(np.float32(limit)), "0": f.constant(np.float32(0.0))}
    names["y - c"] = f.node("Sub", names["y"], names["c"])
    names["y + c"] = f.node("Add", names["y"], names["c"])
    f.node("Where", f.node(compare, names["y"], names["c"]), names[then], names[other])
    return f.write(file)


@pytest.mark.parametrize("name", CHOICES)
def test_choices_without_jumps(name: str, tmp_path: Path) -> None:
    compare, then, other, function = CHOICES[name]
    file = chosen(tmp_path / "net.onnx", compare, then, other)
    network, run = read(file), session(file)
    x = np.random.default_rng(0).normal(size=(1, *SHAPE)).astype(np.float32)
    wanted = function(np.float32(3.0) * x, np.float32(-0.3)).reshape(-1)
    np.testing.assert_array_equal(run(x).reshape(-1), wanted)
    np.testing.assert_allclose(network(torch.from_numpy(x)).numpy().reshape(-1), wanted, rtol=1e-6, atol=1e-6)
    rows = np.random.default_rng(0).normal(size=(2, network.output_size))
    images = image_sets(SHAPE, 1, 2, 0.2, 0.1)
    least, _ = attack(network, run, images, 0, rows, 16, 3)
    lower = bound_outputs(network, images, rows, np.zeros(2)).lower[0]
    assert (lower <= least).all() and np.isfinite(lower).all()


@pytest.mark.parametrize(
    ("compare", "then", "other"), [("Greater", "y", "0"), ("Less", "y", "0"), ("Greater", "y + c", "0")]
)
def test_choices_that_jump_are_refused(compare: str, then: str, other: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"chooses by a value|instead of a choice|input . .* is a constant"):
        load_network(chosen(tmp_path / "net.onnx", compare, then, other))
