"""The second stage: what does not change when the picture is turned.

A patch is sampled on rings around its middle. Turned by phi, each ring is shifted: the magnitudes of its Fourier coefficients
stay, their phases tell phi. The harmonic 0 keeps its sign. Magnitudes cannot tell a picture from its mirror image.

All patches of a call are sampled by one `cv2.remap` and transformed by one product of matrices.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from vcmvsp.cosim.types import Array

HARMONICS = 9  # 0 to 8
TURNS = 72  # a rotation is looked for in steps of 5 deg


@dataclass(frozen=True, eq=False)
class Signature:
    """Of n patches."""

    spectra: Array  # (9, n, m) complex64, m: radii x channels; weighted by the square root of the radius
    unit: Array  # (n, 9 m) float32: the magnitudes, a row of length 1 for a patch


class Rings:
    """Places around the middle of a patch, as parts of its side."""

    def __init__(self, angles: int, radii: int) -> None:
        theta = math.tau / angles * np.arange(angles)[:, None]
        radius = 0.5 / radii * (np.arange(radii) + 0.5)
        self._u = (radius * np.cos(theta)).astype(np.float32)[:, None, :]
        self._v = (-radius * np.sin(theta)).astype(np.float32)[:, None, :]  # v points down; theta to the left
        phase = np.arange(HARMONICS)[:, None] * theta[:, 0]
        self._transform = np.vstack([np.cos(phase), -np.sin(phase)]).astype(np.float32) / angles
        self._weight = np.repeat(np.sqrt(radius), 3).astype(np.float32)
        self._angles, self._radii = angles, radii

    def spectra(self, image: Array, u: Array, v: Array, side_px: Array) -> Array:
        """Of patches with their middles at u, v (n,) px of an RGB picture, of sides (n,) px: (9, n, 3 radii) complex64."""
        n = len(u)
        u, v, side = (values.astype(np.float32)[None, :, None] for values in (u, v, side_px))
        across, down = (u + side * self._u).reshape(self._angles, -1), (v + side * self._v).reshape(self._angles, -1)
        samples = cv2.remap(image, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        parts = product(self._transform, samples.reshape(self._angles, -1).astype(np.float32))
        parts = parts.reshape(2, HARMONICS, n, self._radii, 3)
        parts[0, 0] -= parts[0, 0].mean(axis=1, keepdims=True)  # channel means
        transform: Array = (parts[0] + 1j * parts[1]).reshape(HARMONICS, n, -1) * self._weight
        return transform

    def signatures(self, spectra: Array) -> Signature:
        """The magnitudes that belong to them."""
        size = np.abs(spectra)
        size[0] = spectra[0].real
        rows = np.ascontiguousarray(size.swapaxes(0, 1)).reshape(size.shape[1], -1)
        rows /= np.maximum(np.sqrt(np.einsum("ij,ij->i", rows, rows)), 1e-6)[:, None]
        return Signature(spectra, rows)


def product(a: Array, b: Array) -> Array:
    """Of two matrices, by one thread: the sums come out the same on any number of cores."""
    product: Array = np.einsum("ij,jk->ik", a, b)
    return product


COARSE = Rings(36, 12)  # to find the middle
FULL = Rings(72, 24)  # to judge

_BACK = np.exp(1j * np.outer(math.tau / TURNS * np.arange(TURNS), np.arange(HARMONICS))).astype(np.complex64)


def rotation(spectrum: Array, template: Array) -> float:
    """By how much a patch is turned, rad in [-pi, pi), counter-clockwise: where the circular cross-correlation is greatest.

    Both are spectra (9, m); between the steps of 5 deg a parabola tells.
    """
    curve = product(_BACK, np.einsum("km,km->k", spectrum, template.conj())[:, None])[:, 0].real
    best = int(curve.argmax())
    before, here, after = curve[best - 1], curve[best], curve[(best + 1) % TURNS]
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return (math.tau / TURNS * (best + float(shift)) + math.pi) % math.tau - math.pi
