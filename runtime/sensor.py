"""What stands between a scene's own frames, those of its sensor, and the ideal ones: nothing, where the camera is a pinhole."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from runtime.attitude import Attitude
from runtime.ideal import ideal_scene
from runtime.image import dilated
from runtime.outline import Outline
from runtime.painting import Painting, ideal_pixels_a_pixel
from runtime.refine.optics import Optics
from runtime.scene import Scene
from runtime.sensor_map import SensorMap, runway_beyond

Bits = NDArray[np.bool_]


@dataclass(frozen=True)
class Sensor:
    """A scene's sensor, and the scene that its ideal frame shows."""

    scene: Scene
    ideal: Scene
    """The scene itself where its camera is a pinhole."""
    pixels_a_pixel: int
    """How many pixels of the ideal frame one that the sensor misses may take with it."""
    map: SensorMap | None
    painting: Painting | None

    @staticmethod
    @lru_cache(maxsize=1)
    def of(scene: Scene) -> Sensor:
        """Raises `SceneError` for a lens that folds within the frame, and for a sensor that shows nothing of the runway.

        The last one is kept: a model that is loaded again with another budget has the same.
        """
        if scene.camera.pinhole:
            return Sensor(scene, scene, 1, None, None)
        sensor = SensorMap.of(scene)
        painting = Painting.of(sensor)
        count = ideal_pixels_a_pixel(scene, sensor, painting)
        return Sensor(scene, ideal_scene(scene, sensor.ideal, count), count, sensor, painting)

    @cached_property
    def still(self) -> SensorMap:
        """The map of the sensor, a pinhole's too, for no rotation."""
        return SensorMap.of(self.scene) if self.map is None else self.map

    @cached_property
    def outline(self) -> Outline:
        """Of the sensor's map for no rotation."""
        return Outline.of(self.still)

    @cached_property
    def runway_beyond(self) -> bool:
        """True if a point of the runway may lie beyond the ideal frame, in some state of the domain, where a turned sensor may show it."""
        return runway_beyond(self.ideal)

    @cached_property
    def optics(self) -> tuple[Optics, ...]:
        """What its lens does at the borders of its rows, for parts of its calibration's plus-minus; none for a pinhole known exactly."""
        return Optics.parts_of(self.scene)

    def optics_at(self, attitude: Attitude) -> tuple[Optics, ...]:
        """The same for a frame of this attitude: a pinhole's too, where the plus-minus is visible (`Optics.sways`)."""
        return self.optics or (self._of_pinhole if Optics.sways(self.scene.camera, attitude) else ())

    @cached_property
    def _of_pinhole(self) -> tuple[Optics, ...]:
        return (Optics.of(self.scene.camera, self.scene.calibration),)

    def painted(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The ideal frame of a sensor's frame, uint8 of {0, 1} both: as it is, or painted outward.

        Behind a lens a pixel that fires beside its place is looked for in the sensor's frame: every pixel there counts that has a lit one
        within `line_px`.
        """
        if self.painting is None:
            return pixels
        return self.painting.painted(dilated(pixels.view(np.bool_), self.scene.tolerance.line_px))

    def within(self, mask: Bits, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """What a frame of the sensor has lit that shows some pixel of a mask of the ideal one, uint8 of {0, 1}."""
        return pixels & mask if self.painting is None else self.painting.within(mask, pixels)

    def seen_in(self, mask: Bits) -> Bits:
        """The pixels of the sensor's frame that show some pixel of a mask of the ideal one."""
        return self.within(mask, np.ones(self.scene.camera.shape, dtype=np.uint8)).view(np.bool_)

    @property
    def unseen(self) -> Bits | None:
        """Pixels of the ideal frame, (height, width), that the sensor does not show as a whole; None where there are none."""
        if self.painting is None or not self.painting.unseen.any():
            return None
        return self.painting.unseen.reshape(self.painting.shape)
