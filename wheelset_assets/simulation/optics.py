"""Cameras of the simulator: pinhole with Brown's distortion (OpenCV's five coefficients), both ways.

Here: `Camera`, projection of normalised coordinates, exact rays of pixels. Not here: poses (`rig`), calibration.
Pixel centres have integer coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """Focal lengths and principal point in px, distortion (k1, k2, p1, p2, k3), image size (width, height)."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, float, float, float, float]
    image_size: tuple[int, int]

    @property
    def matrix(self) -> Array:
        """Camera matrix (3, 3) in OpenCV's convention."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    def pixels(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Distorted pixel coordinates u, v of normalised coordinates x = X/Z, y = Y/Z of any shape (Brown 1971)."""
        k1, k2, p1, p2, k3 = self.distortion
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * xx)
        v = y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy
        return self.fx_px * u + self.cx_px, self.fy_px * v + self.cy_px

    def rays(self, u_px: Array, v_px: Array) -> tuple[Array, Array]:
        """Normalised coordinates x, y seen at pixels u, v: Newton's method on `pixels`, exact to rounding."""
        x, y = (u_px - self.cx_px) / self.fx_px, (v_px - self.cy_px) / self.fy_px
        k1, k2, p1, p2, k3 = self.distortion
        for _ in range(5):  # quadratic from an error below 1 %
            u, v = self.pixels(x, y)
            du, dv = (u - u_px) / self.fx_px, (v - v_px) / self.fy_px
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))  # d radial / d(r2), doubled
            xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
            yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
            xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
            det = xx * yy - xy * xy
            x, y = x - (yy * du - xy * dv) / det, y - (xx * dv - xy * du) / det
        return x, y

    def scaled(self, factor: float, image_size: tuple[int, int]) -> Camera:
        """The same lens on a sensor with `factor` times as many pixels along each axis."""
        return Camera(
            self.fx_px * factor,
            self.fy_px * factor,
            (self.cx_px + 0.5) * factor - 0.5,
            (self.cy_px + 0.5) * factor - 0.5,
            self.distortion,
            image_size,
        )
