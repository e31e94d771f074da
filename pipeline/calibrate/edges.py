"""Edges that the images of a sweep show near the scan's outline, and how they move with poses and with the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse

from hw.base.arrays import F64, I64
from hw.base.errors import DiscoError
from pipeline.calibrate.outline import edges_along, outline, synthetic
from pipeline.calibrate.sweep import Sweep

SECTORS = 24  # per view: errors of the edges within one are taken as dependent


@dataclass(frozen=True)
class Edges:
    """K edges in all views, each a place on the scan's outline and where the image shows it.

    jacobian: (K, P) pixels by which the outline moves outward there with a sweep's increments; away: (K,) pixels
    outward at which the image shows the edge; length: (K,) pixels of outline that each stands for; sector: (K,) number
    place: (K, 3) mm, object frame; scale: (K,) pixels per mm of the surface's motion along its own normal
    hats: (K, V) pixels per mm by which each vertex moves along its normal; piece: (K,) number of the edge of the mesh,
    in its view, that the place lies on
    """

    jacobian: F64
    away: F64
    length: F64
    sector: I64
    place: F64
    scale: F64
    hats: sparse.csr_array
    piece: I64

    @classmethod
    def of(
        cls, sweep: Sweep, images: Sequence[NDArray[np.floating]], mesh: trimesh.Trimesh, normals: F64, exact: bool
    ) -> Edges:
        """In (H, W) images of all views. normals: (V, 3) along which the mesh's vertices may move.

        exact: where the edge is found in a synthetic image of the same pose is taken off, and with it the edge model's
        bias

        Raises: DiscoError where no edge lies near the outline.
        """
        rows = [_in_view(sweep, v, image, mesh, normals, exact) for v, image in enumerate(images)]
        of_view = np.concatenate([v + len(rows) * r.piece for v, r in enumerate(rows)])
        found = cls(
            jacobian=np.concatenate([r.jacobian for r in rows]),
            away=np.concatenate([r.away for r in rows]),
            length=np.concatenate([r.length for r in rows]),
            sector=np.concatenate([r.sector for r in rows]),
            place=np.concatenate([r.place for r in rows]),
            scale=np.concatenate([r.scale for r in rows]),
            hats=sparse.csr_array(sparse.vstack([r.hats for r in rows])),
            piece=np.unique(of_view, return_inverse=True)[1],
        )
        if not len(found.away):
            raise DiscoError(
                "the silhouettes show no edge near the scan's outline. Remedy: check that the scan is of this object, "
                "in mm and in the object's frame"
            )
        return found

    @property
    def view(self) -> I64:
        """(K,) of each."""
        return self.sector // SECTORS

    def by_piece(self, weight: F64) -> Edges:
        """Means over the edges on one piece of the outline, weighted by (K,); their own errors are hardly dependent."""
        total = np.bincount(self.piece, weight)
        shape = (len(total), len(self.piece))
        mean = sparse.csr_array((weight / total[self.piece], (self.piece, np.arange(shape[1]))), shape=shape)
        first = np.unique(self.piece, return_index=True)[1]
        return Edges(
            jacobian=np.asarray(mean @ self.jacobian),
            away=np.asarray(mean @ self.away),
            length=np.asarray(np.bincount(self.piece, self.length), np.float64),
            sector=self.sector[first],
            place=np.asarray(mean @ self.place),
            scale=np.asarray(mean @ self.scale),
            hats=sparse.csr_array(mean @ self.hats),
            piece=np.arange(len(total)),
        )


def _in_view(
    sweep: Sweep, view: int, image: NDArray[np.floating], mesh: trimesh.Trimesh, normals: F64, exact: bool
) -> Edges:
    camera = sweep.view(view)
    rim = outline(mesh, camera)
    away, good = edges_along(image, rim.pixel, rim.normal)
    if exact:
        bias, also = edges_along(synthetic(mesh, camera, image), rim.pixel, rim.normal)
        away, good = away - bias, good & also
    around = np.arctan2(*(rim.pixel - rim.pixel.mean(axis=0)).T[::-1]) if len(rim.pixel) else np.zeros(0)
    sector: I64 = view * SECTORS + np.minimum((around / (2 * np.pi) + 0.5) * SECTORS, SECTORS - 1).astype(np.int64)
    depth = rim.points @ camera.pose[2, :3] + camera.pose[2, 3]
    scale = camera.focal.mean() / (depth * np.linalg.norm(rim.across[:, :2], axis=1))
    along = (normals[rim.ends] @ camera.pose[:3, :3].T * rim.across[:, None]).sum(axis=2)  # (K, 2) of both ends
    values = scale[:, None] * rim.shares * along
    rows = np.repeat(np.arange(len(away)), 2)
    hats = sparse.csr_array((values.ravel(), (rows, rim.ends.ravel())), shape=(len(away), len(normals)))
    piece = np.unique(np.sort(rim.ends, axis=1), axis=0, return_inverse=True)[1].ravel()
    return Edges(
        sweep.jacobian(view, rim)[good], away[good], rim.length[good], sector[good], rim.points[good], scale[good],
        hats[good], np.asarray(piece[good], np.int64),
    )  # fmt: skip
