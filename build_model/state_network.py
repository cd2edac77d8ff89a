"""NN_e, the small network that estimates the state from the filtered frame (paper, section III.A): its shape and its training.

It is not certified; the runtime keeps an estimate only inside the certified box. Training frames are exact images of random
states of the domain with pixels missed and clutter added, and pass the same NN_F that stands before the network in the model.
Everything random comes from one seed, and every sum has a fixed order: the same seed gives the same weights to the last bit.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from build_model.partition import partition
from build_model.spatial_filter import spatial_window
from build_model.window import Window
from runtime.camera import project
from runtime.image import image_of_ends, runway_image
from runtime.scene import STATE_NAMES, STATE_UNITS, Scene
from runtime.sensor import Sensor

if TYPE_CHECKING:
    from rich.table import Table

Frames = NDArray[np.uint8]
Filter = Callable[[Frames], Frames]
"""NN_F on many frames: uint8 (n, height, width) to uint8 (n, height, width)."""
Progress = Callable[[str, int, int, float | None], None]
"""Called with a stage, steps done, steps in all, and the loss where there is one."""

BLOCK_ROWS = 4
"""Rows by which the first convolution moves on; its kernel is twice as high."""
CHANNELS = (32, 64, 96, 128)
"""Channels of the first, second, ... convolution; later ones, which only higher windows need, have as many as the last here."""
POSITIONS = 8
"""The window is convolved until at most this many positions along its rows are left for the dense layers."""
HIDDEN = 64

LEARNING_RATE = 6e-3
WARM_UP = 0.15
"""Share of the steps in which the learning rate rises, before it falls to 0 along a cosine."""
SHARDS = 2
"""Parts of a batch whose gradients are taken in parallel, each by one thread of torch. Sums are then in an order of their own, which
neither the machine's load nor its number of cores changes; and threads that wait for each other only once a step bear a busy machine."""
LARGEST_MISSED = 8
"""Half of the training frames miss 1 to this many pixels of the runway, the others none."""
CLEAN_SHARE = 0.1
"""Share of the training frames without any clutter: a network that never saw one is twice as far off on clean frames."""
VALIDATION_FRAMES = 1000
VALIDATION_CLUTTER = (0.0, 0.02, 0.05)
FRAMES_AT_ONCE = 64


@dataclass(frozen=True)
class ValidationError:
    """Errors at one density of clutter. 2-norms are over (theta rad, x m, y m, z m) together, as the paper gives them."""

    clutter: float
    median: float
    percentile_95: float
    axis_median: tuple[float, ...]
    axis_percentile_95: tuple[float, ...]


@dataclass(frozen=True)
class TrainingReport:
    """How the training went. A loss is the mean 2-norm of the error in half-widths of the domain, over the free axes."""

    training_frames: int
    parameters: int
    training_loss: tuple[float, ...]
    """Mean over each epoch's steps."""
    validation_loss: tuple[float, ...]
    """After each epoch, on frames drawn like the training frames and not among them."""
    validation: tuple[ValidationError, ...]

    def table(self) -> Table:
        """The validation errors as a table to print."""
        from rich.table import Table

        title = f"NN_e: {self.parameters} weights, loss {self.training_loss[-1]:.4f}, on unseen frames {self.validation_loss[-1]:.4f}"
        axes = (f"{name} ({unit})" for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True))
        table = Table("clutter", "2-norm", *axes, title=title, title_justify="left")
        for row in self.validation:
            medians, tails = (row.median, *row.axis_median), (row.percentile_95, *row.axis_percentile_95)
            table.add_row(f"{row.clutter:.0%}", *(f"{median:.4f}, 95 %: {tail:.4f}" for median, tail in zip(medians, tails, strict=True)))
        return table


class RowConvolution(nn.Module):
    """Convolution along the rows with columns as channels: a kernel of 2 BLOCK_ROWS rows, moved on by BLOCK_ROWS.

    A block of rows lies in memory as one vector, so the whole layer is one matrix product and one sum of neighbouring blocks. This
    trains twice as fast as `nn.Conv1d`, which first has to transpose the image.
    """

    def __init__(self, columns: int, channels: int) -> None:
        super().__init__()
        self.halves = nn.Linear(BLOCK_ROWS * columns, 2 * channels)
        self.channels = channels

    def forward(self, image: Tensor) -> Tensor:
        """`image`: float32 (n, rows, columns), rows a multiple of BLOCK_ROWS. Returns (n, channels, rows / BLOCK_ROWS - 1)."""
        upper, lower = self.halves(image.reshape(len(image), image.shape[1] // BLOCK_ROWS, -1)).split(self.channels, dim=2)
        return (upper[:, :-1] + lower[:, 1:]).transpose(1, 2)


class StateNetwork(nn.Module):
    """NN_e: crop to the window of all S, convolutions along the rows, two dense layers, scaling to the domain.

    Where a column changes along a marking, and where a marking ends, are facts about rows; hence the kernels along rows. A fixed axis
    comes out as its value, exactly: it is scaled by a half-width of 0.
    """

    middle: Tensor
    half_width: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.frame_shape = scene.camera.shape
        self.window = in_whole_blocks(domain_window(scene), scene.camera.height)
        rows, columns = self.window.shape
        blocks = max(2, -(-rows // BLOCK_ROWS))
        self.padding = blocks * BLOCK_ROWS - rows
        self.first = RowConvolution(columns, CHANNELS[0])
        self.convolutions = nn.ModuleList()
        positions, channels = blocks - 1, CHANNELS[0]
        while positions > POSITIONS:
            following = CHANNELS[min(len(self.convolutions) + 1, len(CHANNELS) - 1)]
            self.convolutions.append(nn.Conv2d(channels, following, kernel_size=(1, 3), stride=(1, 2)))  # see `normalised`
            positions, channels = (positions - 3) // 2 + 1, following
        self.hidden = nn.Linear(positions * channels, HIDDEN)
        self.last = nn.Linear(HIDDEN, len(STATE_NAMES))
        lower, upper = scene.domain.lower, scene.domain.upper
        self.register_buffer("middle", torch.tensor((lower + upper) / 2, dtype=torch.float32))
        self.register_buffer("half_width", torch.tensor((upper - lower) / 2, dtype=torch.float32))

    def forward(self, filtered: Tensor) -> Tensor:
        """`filtered`: (n, 1, height, width) of {0, 1}, uint8 or float. Returns (n, 4) float32: theta (rad), x, y, z (m)."""
        rows, columns = self.window.slices
        image = filtered[:, :, :, columns][:, :, rows].squeeze(1).to(torch.float32)  # the export slices one axis at a time: narrowest first
        return self.middle + self.half_width * self.normalised(image)

    def normalised(self, image: Tensor) -> Tensor:
        """The state in half-widths from the domain's middle, (n, 4). `image`: float32 (n, rows, columns), the window's pixels.

        The signal is a picture of one row: onnxruntime convolves those twice as fast as a bare sequence.
        """
        signal = functional.relu(self.first(functional.pad(image, (0, 0, 0, self.padding)) if self.padding else image)).unsqueeze(2)
        for convolution in self.convolutions:
            signal = functional.relu(convolution(signal))
        return self.last(functional.relu(self.hidden(signal.flatten(1))))


def state_graph(network: StateNetwork, opset: int) -> onnx.ModelProto:
    """NN_e as a static ONNX model of standard operators: uint8 [1, 1, height, width] to float32 [1, 4].

    torch's exporter warns of its own use of a deprecated call, and logs that torchvision is missing, which nothing here needs: both
    are kept from the user.
    """
    example = torch.zeros((1, 1, *network.frame_shape), dtype=torch.uint8)
    log = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = log.level
    try:
        log.setLevel(logging.ERROR)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=r".*LeafSpec.* is deprecated", category=FutureWarning)
            program = torch.onnx.export(network, (example,), dynamo=True, opset_version=opset, optimize=True, verbose=False)
    finally:
        log.setLevel(level)
    if program is None:
        raise RuntimeError("torch.onnx.export gave no program")
    return program.model_proto


def domain_window(scene: Scene) -> Window:
    """The smallest window that holds S of every cell: what lies outside it is dark in every filtered frame."""
    cells = partition(scene)
    return reduce(Window.union, (spatial_window(scene, lower, upper) for lower, upper in zip(cells.lower, cells.upper, strict=True)))


def in_whole_blocks(window: Window, height: int) -> Window:
    """The window with rows added, below it first, to a multiple of BLOCK_ROWS or as far as the frame's height allows."""
    lacking = -window.shape[0] % BLOCK_ROWS
    below = min(lacking, height - window.bottom)
    above = min(lacking - below, window.top)
    return Window(window.top - above, window.bottom + below, window.left, window.right)


@dataclass(frozen=True)
class FilteredFrames:
    """The window's pixels of filtered frames, 8 to a byte, beside the true states (n, 4)."""

    states: NDArray[np.float64]
    bits: Frames
    window: Window

    def __len__(self) -> int:
        return len(self.states)

    def images(self, chosen: NDArray[np.int64] | slice) -> Tensor:
        """The chosen frames, float32 (n, rows, columns)."""
        rows, columns = self.window.shape
        pixels = np.unpackbits(self.bits[chosen], axis=1, count=rows * columns)
        return torch.from_numpy(pixels).reshape(-1, rows, columns).to(torch.float32)


@dataclass(frozen=True)
class FrameSource:
    """Draws frames of a scene: random states of the domain, missed pixels, clutter, then NN_F. Behind a lens, whose `sensor` is given, all
    of this is of the sensor's own frame, which is then painted, as NN_F and NN_e will see it.
    """

    scene: Scene
    window: Window
    filter_frames: Filter
    sensor: Sensor | None = None

    def draw(
        self, count: int, rng: np.random.Generator, clutter: float | None = None, advance: Callable[[int], None] = lambda _done: None
    ) -> FilteredFrames:
        """`count` frames; with `clutter` of that density and no missed pixels, without it of random density and misses."""
        parts = []
        for start in range(0, count, FRAMES_AT_ONCE):
            parts.append(self._batch(min(FRAMES_AT_ONCE, count - start), rng, clutter))
            advance(min(start + FRAMES_AT_ONCE, count))
        states, bits = (np.concatenate(part) for part in zip(*parts, strict=True))
        return FilteredFrames(states, bits, self.window)

    def _batch(self, count: int, rng: np.random.Generator, clutter: float | None) -> tuple[NDArray[np.float64], Frames]:
        states = self.scene.domain.uniform(rng, count)
        crops = self._images(states)
        density = np.full(count, clutter)
        if clutter is None:
            miss_pixels(crops, rng.integers(1, LARGEST_MISSED + 1, count) * (rng.random(count) < 0.5), rng)
            density = self.scene.estimator.largest_clutter * np.square(rng.random(count)) * (rng.random(count) >= CLEAN_SHARE)
        crops |= rng.random(crops.shape, dtype=np.float32) < density[:, None, None]
        filtered = self.filter_frames(self._ideal_frames(crops))[:, *self.window.slices]
        return states, np.packbits(filtered.reshape(count, -1), axis=1)

    def _images(self, states: NDArray[np.float64]) -> Frames:
        """The runway's images, (n, rows, columns): the window's pixels, or those of the sensor that show something of the ideal frame."""
        if self.sensor is None or self.sensor.painting is None:
            return image_of_ends(project(self.scene, states) - [self.window.left, self.window.top], self.window.shape)
        return runway_image(self.sensor.scene, states)[:, *self.sensor.painting.window]

    def _ideal_frames(self, crops: Frames) -> Frames:
        """The ideal frames (n, height, width) of such parts."""
        if self.sensor is None or self.sensor.painting is None:
            frames = np.zeros((len(crops), *self.scene.camera.shape), dtype=np.uint8)
            frames[:, *self.window.slices] = crops
            return frames
        sensor, own = self.sensor, np.zeros(self.sensor.scene.camera.shape, dtype=np.uint8)
        frames = np.empty((len(crops), *self.scene.camera.shape), dtype=np.uint8)
        for frame, crop in zip(frames, crops, strict=True):
            own[self.sensor.painting.window] = crop
            frame[:] = sensor.painted(own)
        return frames


def miss_pixels(frames: Frames, missed: NDArray[np.int64], rng: np.random.Generator) -> None:
    """Darkens `missed[i]` random lit pixels of frame i, or all that it has, in place. `frames`: (n, rows, columns)."""
    lit = np.stack(np.nonzero(frames))
    shuffled = lit[:, np.lexsort((rng.random(lit.shape[1]), lit[0]))]
    rank = np.arange(lit.shape[1]) - np.searchsorted(lit[0], lit[0])
    frame, row, column = shuffled[:, rank < missed[lit[0]]]
    frames[frame, row, column] = 0


def train_state_network(
    scene: Scene,
    filter_frames: Filter,
    seed: int,
    progress: Progress = lambda _stage, _done, _total, _loss: None,
    sensor: Sensor | None = None,
) -> tuple[StateNetwork, TrainingReport]:
    """NN_e of the scene, trained as its [estimator] table says. The same arguments give the same weights on the same CPU features.

    `sensor`: of a camera with a lens, whose ideal scene this is; NN_e is trained on its frames as they are painted.

    The caller's random state and settings of torch are left as they were.
    """
    training = scene.estimator
    with _reproducible(seed):
        network = StateNetwork(scene)
        source = FrameSource(scene, network.window, filter_frames, sensor)
        of_training, of_validation, of_order = (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3))
        total = training.training_frames
        frames = source.draw(total, of_training, advance=lambda done: progress("frames for NN_e", done, total, None))
        unseen_count = min(VALIDATION_FRAMES, total)
        unseen = source.draw(unseen_count, of_validation)
        training_loss, validation_loss = _fit(network, frames, unseen, of_order, scene, progress)
        validation = [
            validation_error(network, source.draw(unseen_count, of_validation, clutter), clutter) for clutter in VALIDATION_CLUTTER
        ]
    weights = sum(parameter.numel() for parameter in network.parameters())
    return network.eval(), TrainingReport(total, weights, tuple(training_loss), tuple(validation_loss), tuple(validation))


@contextmanager
def _reproducible(seed: int) -> Iterator[None]:
    """Torch with this seed, deterministic algorithms and one thread; what was set before comes back afterwards."""
    threads, deterministic = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    with torch.random.fork_rng(devices=[]):
        try:
            torch.set_num_threads(1)
            torch.use_deterministic_algorithms(True)
            torch.manual_seed(seed)
            # MKL picks the kernel of a function at its first call: if two threads make that one, one of them may get a kernel that is
            # right to some thousand units in the last place only (pytorch/pytorch issue 188792). The loss takes roots in two threads.
            torch.sqrt(torch.ones(1))
            yield
        finally:
            torch.set_num_threads(threads)
            torch.use_deterministic_algorithms(deterministic)


def _fit(
    network: StateNetwork, frames: FilteredFrames, unseen: FilteredFrames, rng: np.random.Generator, scene: Scene, progress: Progress
) -> tuple[list[float], list[float]]:
    """Adam over all epochs. Returns the training and the validation loss of each."""
    epochs, batches = scene.estimator.epochs, math.ceil(len(frames) / scene.estimator.batch)
    optimiser = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: learning_rate_share(step, epochs * batches))
    training_loss, validation_loss = [], []
    # A new thread does not take over the setting of the thread that starts it.
    with ThreadPoolExecutor(SHARDS, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        for epoch in range(epochs):
            losses = []
            for batch, chosen in enumerate(np.array_split(rng.permutation(len(frames)), batches)):
                losses.append(_set_gradients(network, frames, chosen, pool))
                optimiser.step()
                schedule.step()
                progress("training NN_e", epoch * batches + batch + 1, epochs * batches, losses[-1])
            training_loss.append(float(np.mean(losses)))
            validation_loss.append(float(_loss(network, _scaled(network, unseen), unseen.states).mean()))
    return training_loss, validation_loss


def _set_gradients(network: StateNetwork, frames: FilteredFrames, chosen: NDArray[np.int64], pool: ThreadPoolExecutor) -> float:
    """Gradients of the mean loss over the chosen frames, taken in SHARDS parts and summed in their order. Returns the loss."""
    parameters = list(network.parameters())

    def gradients(part: NDArray[np.int64]) -> tuple[float, tuple[Tensor, ...]]:
        loss = _loss(network, network.normalised(frames.images(part)), frames.states[part]).sum() / len(chosen)
        return loss.item(), torch.autograd.grad(loss, parameters)

    losses, parts = zip(*pool.map(gradients, np.array_split(chosen, min(SHARDS, len(chosen)))), strict=True)
    for parameter, *shares in zip(parameters, *parts, strict=True):
        parameter.grad = sum(shares[1:], start=shares[0])
    return sum(losses)


def learning_rate_share(step: int, steps: int) -> float:
    """The learning rate of a step as a share of the largest: up along a line for WARM_UP of the steps, then down to 0 along a cosine."""
    position, peak = (step + 1) / (steps + 1), WARM_UP
    return position / peak if position < peak else (1 + math.cos(math.pi * (position - peak) / (1 - peak))) / 2


def _loss(network: StateNetwork, scaled: Tensor, states: NDArray[np.float64]) -> Tensor:
    """2-norm, over the free axes, of the error of `scaled` (n, 4) in half-widths of the domain; true states (n, 4). Returns (n,)."""
    free = network.half_width > 0
    truth = (torch.from_numpy(states).to(torch.float32) - network.middle)[:, free] / network.half_width[free]
    squares = (scaled[:, free] - truth).square().sum(dim=1)
    return torch.sqrt(squares + 1e-6)  # 1e-6 keeps the gradient finite where the error is 0


@torch.no_grad()
def _scaled(network: StateNetwork, frames: FilteredFrames) -> Tensor:
    """The network's states in half-widths from the domain's middle, (n, 4)."""
    starts = range(0, len(frames), FRAMES_AT_ONCE)
    return torch.cat([network.normalised(frames.images(slice(start, start + FRAMES_AT_ONCE))) for start in starts])


def validation_error(network: StateNetwork, frames: FilteredFrames, clutter: float) -> ValidationError:
    """Error of the network's states on frames with clutter of the given density."""
    error = np.abs((network.middle + network.half_width * _scaled(network, frames)).numpy() - frames.states)
    median, percentile_95 = np.quantile(np.linalg.norm(error, axis=1), [0.5, 0.95]).tolist()
    axis_median, axis_percentile_95 = np.quantile(error, [0.5, 0.95], axis=0).tolist()
    return ValidationError(clutter, median, percentile_95, tuple(axis_median), tuple(axis_percentile_95))
