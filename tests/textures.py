"""Images of a made texture and of the same texture under an affine map, exact at every place."""

from dataclasses import dataclass

import numpy as np

MAP = np.array([[1.04, 0.03], [-0.02, 0.96]])
SHIFT = np.array([3.3, -2.7])


@dataclass(frozen=True, eq=False, kw_only=True)
class Texture:
    """A sum of plane waves: every place has a value, and nothing needs to be interpolated."""

    waves: np.ndarray
    """(n, 2) [rad/px]."""
    phases: np.ndarray
    contrast: float
    """Standard deviation of the grey values."""

    @staticmethod
    def draw(rng: np.random.Generator, *, count=60, shortest=5.0, longest=30.0, contrast=30.0) -> "Texture":
        length = np.exp(rng.uniform(np.log(shortest), np.log(longest), count))
        direction, phases = rng.uniform(0, 2 * np.pi, (2, count))
        waves = 2 * np.pi / length[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
        return Texture(waves=waves, phases=phases, contrast=contrast)

    def __call__(self, places: np.ndarray) -> np.ndarray:
        """Grey values (...) at places (..., 2)."""
        total = np.zeros(places.shape[:-1])
        for wave, phase in zip(self.waves, self.phases, strict=True):
            total += np.cos(places @ wave + phase)
        return 120 + self.contrast * np.sqrt(2 / len(self.phases)) * total


    def image(self, shape: tuple[int, int], turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Grey values (H, W) at the places [x, y] @ turn + shift of the pixels, by products of rows and columns."""
        height, width = shape
        along, down = self.waves @ turn.T[:, 0], self.waves @ turn.T[:, 1]
        rows = np.exp(1j * (np.arange(height)[:, None] * down + self.phases + self.waves @ shift))
        total = (rows @ np.exp(1j * along[:, None] * np.arange(width))).real
        return 120 + self.contrast * np.sqrt(2 / len(self.phases)) * total


@dataclass(frozen=True, eq=False, kw_only=True)
class Pair:
    """A template, a search image of another size, and the truth."""

    template: np.ndarray
    search: np.ndarray
    centre: np.ndarray

    def carried(self, pixels: np.ndarray) -> np.ndarray:
        """Where the template's pixels lie in the search image."""
        return (pixels - self.centre) @ MAP.T + self.centre + SHIFT

    def grid(self, step: int, *, margin: int = 25) -> np.ndarray:
        height, width = self.template.shape
        y, x = np.mgrid[margin : height - margin : step, margin : width - margin : step]
        return np.stack([x.ravel(), y.ravel()], axis=-1).astype(float)


def make_pair(
    rng: np.random.Generator, shape: tuple[int, int], *, noise: float, gain=0.9, offset=12.0, kind=np.uint8, **texture
) -> Pair:
    """Film a texture twice, with noise in both images."""
    surface, centre = Texture.draw(rng, **texture), np.array([shape[1], shape[0]]) / 2
    template = surface.image(shape, np.eye(2), np.zeros(2))
    wider, back = (shape[0] + 7, shape[1] + 13), np.linalg.inv(MAP).T
    pictures = [template, gain * surface.image(wider, back, centre - (centre + SHIFT) @ back) + offset]
    pictures = [picture + rng.normal(0, noise, picture.shape) for picture in pictures]
    if kind is np.uint8:
        pictures = [np.clip(np.round(picture), 0, 255) for picture in pictures]
    return Pair(template=pictures[0].astype(kind), search=pictures[1].astype(kind), centre=centre)
