"""An autoencoder of poses (MNN-IK, section 3 and appendix A): a network that squeezes a pose through a few numbers.

The network's own code is of no particular size; here it is measured in the deviations that encoded poses have, so that a code
costs half its square. What a network misses it misses in many joints at once, most of all of people it has not seen; so further
numbers of the code are deviations along the directions in which poses stray from the network's.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from mocapfix.prior.contract import PoseModel, checked
from mocapfix.prior.features import KINDS, Features
from mocapfix.prior.network import Network, Shape, built, through

BATCH = 512  # poses at once: memory stays small, and a larger batch is hardly faster


@dataclass(frozen=True)
class Autoencoder(PoseModel):
    """A trained network.

    shape   what it is made of: kind of features, hidden layers, code, activation
    mean    (N,) of the network's own code of people's poses; that is mean + spread code, of the code's first N numbers
    spread  (N, N) lower triangular
    astray  (P - N, J, 3) radians: how poses stray from the network's, each row for one deviation of another number of the code
    """

    shape: Shape
    network: Network
    mean: np.ndarray
    spread: np.ndarray
    astray: np.ndarray

    @cached_property
    def features(self) -> Features:
        return KINDS[self.shape.features](torch.as_tensor(self.middle, dtype=torch.float32))

    @cached_property
    def given(self) -> Features:
        return KINDS[self.shape.gives](torch.as_tensor(self.middle, dtype=torch.float32))

    @property
    def size(self) -> int:
        return len(self.mean) + len(self.astray)

    @property
    def bent(self) -> int:
        return len(self.mean)

    def encode(self, vectors: np.ndarray) -> np.ndarray:
        """-> (N, P): the network's numbers, and the likeliest of the others beside these."""
        own, decoded = batched(self._encoded, vectors)
        axes = 3 * len(self.joints)
        weights = (self.astray / self.sigma[:, None]).reshape(len(self.astray), axes)
        away = ((vectors - decoded) / self.sigma[:, None]).reshape(len(vectors), axes)
        others = np.linalg.solve(weights @ weights.T + np.eye(len(weights)), weights @ away.T).T
        return np.concatenate([np.linalg.solve(self.spread, (own - self.mean).T).T, others], axis=1)

    def decode(self, codes: np.ndarray) -> np.ndarray:
        (decoded,) = batched(self._decoded, self._own(codes))
        return decoded + self._strayed(codes)

    def linearise(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        decoded, slopes = batched(self._linearised, self._own(codes))
        others = np.broadcast_to(np.moveaxis(self.astray, 0, -1), (*decoded.shape, len(self.astray)))
        return decoded + self._strayed(codes), np.concatenate([slopes, others], axis=-1)

    def packed(self) -> tuple[dict, dict[str, np.ndarray]]:
        """Half precision for the weights: sigma, mean and spread were measured after rounding them."""
        weights = {f"network.{name}": w.numpy().astype(np.float16) for name, w in self.network.state_dict().items()}
        tensors = {name: getattr(self, name).astype(np.float32) for name in ("middle", "sigma", "mean", "spread", "astray")}
        return {"shape": asdict(self.shape)}, tensors | weights

    @classmethod
    def unpacked(cls, joints: tuple[str, ...], said: dict, tensors: dict[str, np.ndarray]) -> "Autoencoder":
        shape = Shape(**said["shape"] | {"hidden": tuple(said["shape"]["hidden"])})
        weights = {name: tensors.pop(name) for name in list(tensors) if name.startswith("network.")}
        count, size = len(joints), shape.code
        shapes = {"middle": (count, 3, 3), "sigma": (count,), "mean": (size,), "spread": (size, size)}
        known = checked(tensors, **shapes, astray=(shape.astray, count, 3))
        network = built(shape, known["middle"])
        state = {name.removeprefix("network."): torch.from_numpy(w.astype(np.float32)) for name, w in weights.items()}
        network.load_state_dict(state, strict=True)
        return cls(joints, known.pop("middle"), known.pop("sigma"), shape, network.eval(), **known)

    def _own(self, codes: np.ndarray) -> np.ndarray:
        return self.mean + codes[:, : len(self.mean)] @ self.spread.T

    def _strayed(self, codes: np.ndarray) -> np.ndarray:
        return np.tensordot(codes[:, len(self.mean) :], self.astray, 1)

    def _encoded(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        own = self.network.encoder(self.features.of(vectors))
        return own, *self._decoded(own)

    def _decoded(self, own: Tensor) -> tuple[Tensor]:
        return (self.given.vectors(self.network.decoder(own)),)

    def _linearised(self, own: Tensor) -> tuple[Tensor, Tensor]:
        features, slopes = through(self.network.decoder, own, torch.as_tensor(self.spread.T, dtype=torch.float32))
        return self.given.linearised(features, slopes)


@contextmanager
def one_core() -> Iterator[None]:
    """Let torch use one core for what this thread asks of it."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def batched(function: Callable[[Tensor], tuple[Tensor, ...]], rows: np.ndarray) -> list[np.ndarray]:
    """-> float64, what a function of torch says of the rows, a batch at a time.

    On one core: those who want more call it from several threads, which then need not wait for each other after every layer.
    """
    with torch.no_grad(), one_core():
        parts = [function(part) for part in torch.as_tensor(np.asarray(rows, np.float32)).split(BATCH)]
        return [torch.cat(said).double().numpy() for said in zip(*parts, strict=True)]
