"""What a training run is: a JSON file beside the network.json that it trains."""

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

from .errors import InputError
from .network import Network


@dataclass(frozen=True)
class Seeds:
    """A set of frames: `voxcast synth --seed first --count count`."""

    first: int
    count: int


@dataclass(frozen=True)
class Phase:
    """How the losses are weighted from step `start` on.

    The affinities teach fast, but where a place is uncertain they prefer too much of a rare class to too little. What is
    measured in the end is IoU, which Lovasz-softmax follows.
    """

    start: int = 0
    focal: float = 1.0
    lovasz: float = 1.0
    geometric: float = 1.0
    semantic: float = 1.0
    class_power: float = 0.25
    """Class weights of the focal loss are (count of a class)^-power, scaled to a mean of 1 over the classes that occur."""
    volumes: bool = True
    """False: only the heads of the pixels teach, and the image half runs alone. A step takes less than half of the time."""


@dataclass(frozen=True)
class Jitter:
    """Rings whose mounting is off: so many, each camera turned and moved by up to so much."""

    rigs: int
    degrees: float
    metres: float
    share: float
    """Of the steps, and of the frames."""


@dataclass(frozen=True)
class Tail:
    """Training of the end of a network alone, after the run, on frames of its own (`tail.py`)."""

    first: int = 20_000
    count: int = 160
    """Seeds of its frames."""
    steps: int = 400
    minutes: float | None = None
    """Time to train for, instead of steps."""
    batch: int = 4
    learning_rate: float = 1e-3
    average: float = 0.99
    """Decay of the running average of the weights, which is what is kept."""
    masked: float = 0.2
    lovasz_voxels: int = 60_000
    volumes: bool = False
    """Train everything behind the gather, not the last stage alone."""
    precision: str = "f32"
    """As of a run; `bf16` here is faster on CPUs with AVX512-BF16 too."""
    jitter: Jitter | None = None
    """Other rigs that its frames are drawn for, the first ones of its seeds: so many for each, which together are the share."""

    def seeds_of(self, rig: int) -> Seeds:
        """The frames of a rig, by number; 0 is the plain one, whose seeds come last."""
        if self.jitter is None:
            return Seeds(self.first, self.count)
        each = round(self.count * self.jitter.share / self.jitter.rigs)
        if rig > 0:
            return Seeds(self.first + (rig - 1) * each, each)
        return Seeds(self.first + self.jitter.rigs * each, self.count - self.jitter.rigs * each)


@dataclass(frozen=True)
class Config:
    """Every number that decides a run, together with the sets and the rig."""

    train: Seeds
    tune: Seeds
    held_out: Seeds
    steps: int
    """With `minutes`, what phases, warm-up and rates are counted in; as many are taken as the time allows."""
    batch: int
    network: str = "network.json"
    after: str | None = None
    """Another config, beside this one: training starts from the model that its run gave."""
    minutes: float | None = None
    """Time to train for: phases and rates follow the clock instead of the steps."""
    drawn: str = "before"
    """`before`: the set `train` is complete when training starts, and held in memory. `beside`: up to `train.count` frames
    are drawn while it runs and used as they come, which needs `--voxcast`."""
    ready: int = 256
    """Frames that must be there before the first step, if they are drawn beside it."""
    drawers: int = 0
    """Processes that draw; 0: one for each core but two."""
    jitter: Jitter | None = None
    """The other rigs to train for, if frames are drawn beside."""
    tail: Tail | None = None
    """What is done with the last stage afterwards, if anything."""
    shifts: bool = True
    """Whether one shift of the logits for each class is fitted to the tuning frames at the end (`calibrate.py`)."""
    masked: float = 0.0
    """Share of the frames of which one camera is masked: its pixels are left out of every mean."""
    seed: int = 0
    learning_rate: float = 2e-3
    """Peak; reached linearly over `warm_up` steps, then falling to nothing along a cosine. Where a phase starts to teach the
    volumes after one that did not, the rate is reached anew."""
    warm_up: int = 200
    backbone_factor: float = 1.0
    """The backbone's learning rate over that of the rest. Fine-tuning wants 0.1."""
    weight_decay: float = 0.01
    clip: float = 10.0
    """Largest norm of the gradient of all parameters together."""
    momentum: float = 0.05
    """Share of the newest batch in BatchNorm's running statistics."""
    average: float = 0.998
    """Decay of the running average of the weights, which is what is evaluated and exported."""
    phases: tuple = (Phase(),)
    lovasz_voxels: int = 20000
    auxiliary: float = 0.5
    """Weight of the losses of heads that only training has; it falls to a fifth of that along a straight line."""
    precision: str = "f32"
    """`bf16` runs convolutions in bfloat16, which is faster on CPUs with AMX and on GPUs; weights stay f32."""
    workers: int = 1
    """Processes that share a batch, each with its part of the frames. On CPUs, one for each core with one thread is faster
    than one process with a thread for each core: nothing waits within an operation. BatchNorm sees a worker's part."""
    threads: int = 2
    """Of one worker."""
    log_every: int = 20
    save_every: int = 500
    evaluate_every: int = 1000
    save_seconds: float = 60.0
    evaluate_seconds: float = 90.0
    """With `minutes`, instead of steps."""
    directory: Path = field(default=Path("."), compare=False)

    @staticmethod
    def load(path) -> "Config":
        """Reads a config. Raises InputError naming the file and the key."""
        path = Path(path)
        try:
            values = json.loads(path.read_text())
            sets = {key: Seeds(**values.pop(key)) for key in ("train", "tune", "held_out")}
            if values.get("jitter") is not None:
                values["jitter"] = Jitter(**values["jitter"])
            if values.get("tail") is not None:
                jitter = values["tail"].get("jitter")
                values["tail"] = Tail(**{**values["tail"], "jitter": None if jitter is None else Jitter(**jitter)})
            if "phases" in values:
                values["phases"] = tuple(Phase(**phase) for phase in values["phases"])
            config = Config(**sets, **values, directory=path.parent)
        except (KeyError, TypeError, json.JSONDecodeError) as error:
            raise InputError(f"{path}: {error}") from error
        for precision in {config.precision, "f32" if config.tail is None else config.tail.precision}:
            if precision not in ("f32", "bf16"):
                raise InputError(f'{path}: "precision": found {precision}, expected f32 or bf16')
        if config.drawn not in ("before", "beside"):
            raise InputError(f'{path}: "drawn": found {config.drawn}, expected before or beside')
        if config.drawn == "beside" and config.workers != 1:
            raise InputError(f'{path}: "workers": found {config.workers}, expected 1 where frames are drawn beside')
        if config.jitter is not None and config.drawn != "beside":
            raise InputError(f'{path}: "jitter": found with frames drawn before, expected "drawn": "beside"')
        if config.minutes is not None and config.workers != 1:
            raise InputError(f'{path}: "workers": found {config.workers}, expected 1 with "minutes"')
        starts = [phase.start for phase in config.phases]
        if starts[:1] != [0] or starts != sorted(set(starts)):
            raise InputError(f'{path}: "phases": found starts {starts}, expected ascending ones from 0 on')
        if config.after == path.name:
            raise InputError(f'{path}: "after": found the run itself, expected another one')
        if config.batch % config.workers != 0:
            raise InputError(f'{path}: "batch": found {config.batch}, expected a multiple of the {config.workers} workers')
        return config

    def load_network(self) -> Network:
        return Network.load(self.directory / self.network)

    def phase(self, step: float) -> Phase:
        """The phase that a step belongs to."""
        return [phase for phase in self.phases if phase.start <= step][-1]

    def warmed_from(self, step: float) -> int:
        """The step from which on the rate rises to that of `step`."""
        first = 0
        for before, phase in zip(self.phases, self.phases[1:]):
            if phase.start <= step and phase.volumes and not before.volumes:
                first = phase.start
        return first

    def identity(self) -> dict:
        """What must not change between a run and its continuation. A run may be made longer or shorter, and get
        other phases: from then on, the new ones count."""
        values = asdict(self)
        free = ("directory", "steps", "minutes", "phases", "threads", "drawers", "ready", "log_every", "save_every", "evaluate_every",
                "save_seconds", "evaluate_seconds", "tune", "held_out", "tail", "shifts")  # fmt: skip
        for key in free:
            del values[key]
        assert set(values) < {f.name for f in fields(self)}
        return values
