"""The run folder: where things lie, whose scene it is, and which stages are finished (so that a run can resume).

OUT/scene.toml  scene.json  run.log  stages.json  summary.json  report.html  view.html
OUT/inputs/     copies of the files that the scene names: meshes, media
OUT/capture/    all that the pipeline reads        OUT/work/   the pipeline's outputs
OUT/twin/       what the pipeline never sees: the simulated responses, truth, references
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from disco_twin.scene.scene import Scene
from hw.base.config import Strict, as_table, read_json
from hw.base.errors import DiscoError, InputError
from hw.base.files import alone_in, write_atomically, write_json
from hw.base.resources import measured
from pipeline.stream.files import IMAGES, JOURNAL

log = logging.getLogger(__name__)

FORMAT_VERSION = 2
FOLDERS = ("capture", "twin", "work")
INPUTS = "inputs"  # copies of the files that the scene names


@dataclass
class StageRecord:
    """A stage's inputs as a key, and what it took. Seconds add up over interruptions; the peak is the largest.

    outputs: BLAKE2 digest of each file that the finished stage left, by its path in the run folder.
    """

    name: str
    key: str
    seconds: float = 0.0
    peak_mb: float = 0.0
    finished: bool = False
    outputs: dict[str, str] = field(default_factory=dict)

    def damaged(self, root: Path) -> str | None:
        """The first of the files that is no longer what the stage left; None if all are."""
        for path, digest in self.outputs.items():
            if not (root / path).is_file() or file_digest(root / path) != digest:
                return path
        return None


@dataclass
class RunFolder:
    """One run's folder; `identity` is the key of the scene whose capture it holds."""

    root: Path
    identity: str = ""
    stages: dict[str, StageRecord] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.capture, self.twin, self.work = (self.root / name for name in FOLDERS)
        self.scene_file, self.journal = self.root / "scene.toml", self.root / "stages.json"
        self.scene_record = self.root / "scene.json"  # the scene as it was run: profile applied, files from `inputs`
        self.summary_file, self.report_file = self.root / "summary.json", self.root / "report.html"
        self.view_file = self.root / "view.html"
        self.scores_file = self.twin / "scores.json"  # with the truth that they were made from
        self.devices_record = self.capture / "devices.toml"  # the rig file of a capture by devices

    def write_scene(self, scene: Scene) -> None:
        """Write `scene_record`, with copies of the files that the scene names: the folder may be moved elsewhere."""

        def kept(value: Any) -> Any:
            if isinstance(value, dict):
                return {key: kept(v) for key, v in value.items()}
            if isinstance(value, list | tuple):
                return [kept(v) for v in value]
            if not isinstance(value, Path):
                return value
            name = f"{INPUTS}/{file_digest(value)[:8]}-{value.name}"
            (self.root / INPUTS).mkdir(exist_ok=True)
            if not (self.root / name).is_file() or file_digest(self.root / name) != file_digest(value):
                write_atomically(self.root / name, value.read_bytes())
            return name

        write_json(self.scene_record, kept(scene.model_dump()))

    def read_scene(self) -> Scene:
        """Read `scene_record`. Raises: InputError."""
        return read_json(self.scene_record, Scene, f"disco-twin run SCENE --out {self.root} writes it anew")

    @property
    def taken_by_devices(self) -> bool:
        """Whether devices took this folder's images: nothing simulates them again or removes them."""
        return self.devices_record.is_file()

    def variant(self, root: Path) -> RunFolder:
        """A folder to reconstruct in beside this run's own work; capture and truth are this run's."""
        folder = RunFolder(root)
        folder.capture, folder.twin = self.capture, self.twin
        return folder

    @classmethod
    def open(cls, root: Path) -> RunFolder:
        """An existing run folder. Raises: InputError where it is none, or its journal cannot be read."""
        folder = cls(root)
        if not folder.journal.is_file():
            raise InputError("is no run folder", file=root, remedy="give the --out folder of `disco-twin run`")
        folder._load()
        return folder

    @classmethod
    def claim(cls, root: Path, scene_file: Path, identity: str) -> RunFolder:
        """The folder for this scene: made, or resumed. Raises: InputError for a folder that holds anything else."""
        folder = cls(root, identity)
        if root.exists() and not root.is_dir():
            raise InputError("is not a folder", file=root, remedy="choose another --out")
        if folder.journal.is_file():
            folder._load_or_begin_anew(identity)
            if folder.identity != identity:
                problem = "the folder holds the run of another scene or profile, or the scene has changed since"
                raise InputError(problem, file=root, remedy="choose another --out, or delete this one")
        elif root.is_dir() and not _barely_begun(root):
            raise InputError("the folder is not empty and holds no run", file=root, remedy="choose another --out")
        folder.identity = identity
        for name in FOLDERS:
            (root / name).mkdir(parents=True, exist_ok=True)
        with folder.alone():
            write_atomically(folder.scene_file, scene_file.read_bytes())
            folder._save()
        return folder

    def run(self, name: str, key: str, work: Callable[[], float | None], outputs: Sequence[str] = ()) -> bool:
        """Do a stage unless it is finished under the same key; True if it was done now.

        outputs: patterns of the files that it leaves; where one is missing or cut later, the stage is done again.
        `work` may return the peak memory in MiB of a process of its own, which then counts as the stage's.
        Raises: DiscoError where another process works in the folder, and what `work` raises.
        """
        with self.alone():
            if self.journal.is_file():
                self._load()  # another process may have worked here since
            record = self.stages.get(name)
            if record is not None and record.key == key and record.finished:
                path = record.damaged(self.root)
                if path is None:
                    return False
                log.warning("%s: %s is missing or damaged, the stage is done again", name, path)
                record = None
            if record is None or record.key != key:
                record = StageRecord(name, key)
            self.stages[name] = record
            self._save()  # whatever ends this process from here on, the files are no longer those of a finished stage
            self._work(record, work, outputs)
        return True

    def _work(self, record: StageRecord, work: Callable[[], float | None], outputs: Sequence[str]) -> None:
        """Do a stage and write down what it took, whether it comes to its end or not."""
        child: float | None = None
        usage = None
        try:
            with measured() as usage:
                child = work()
            record.finished = True
            files = [path for pattern in outputs for path in self.root.glob(pattern) if path.is_file()]
            record.outputs = {str(path.relative_to(self.root)): file_digest(path) for path in files}
        finally:
            if usage is not None:
                record.seconds += usage.seconds
                record.peak_mb = max(record.peak_mb, usage.peak_mb if child is None else child)
            self._save()

    def alone(self) -> AbstractContextManager[None]:
        """No other process works in the folder meanwhile. Raises: DiscoError where one does."""
        problem = f"{self.root}: another process works in this folder"
        return alone_in(self.root, DiscoError(f"{problem}. Remedy: wait for it, or choose another --out"))

    def _load(self) -> None:
        other = "read it with the version that wrote it, or choose another --out"
        anew = f"disco-twin run SCENE --out {self.root} begins it anew, and looks at every stage again"
        data = read_json(self.journal, _Journal, other if _of_another_version(self.journal) else anew)
        self.identity = data.identity
        self.stages = {record.name: record for record in data.stages}

    def _load_or_begin_anew(self, identity: str) -> None:
        """A journal that cannot be read is begun anew: what stages left is looked at again, nothing is lost.

        Light that other code made is known by keys of its own (twin/*.key).
        """
        try:
            self._load()
        except InputError as error:
            if _of_another_version(self.journal):
                raise
            kept = self.journal.with_suffix(".damaged")
            log.warning("%s; it is kept as %s, and every stage is looked at again", error, kept.name)
            self.journal.replace(kept)
            self.identity = identity

    def _save(self) -> None:
        stages = [asdict(record) for record in self.stages.values()]
        write_json(self.journal, {"format_version": FORMAT_VERSION, "identity": self.identity, "stages": stages})


class _Journal(Strict):
    """stages.json."""

    format_version: Literal[2]
    identity: str
    stages: tuple[Annotated[StageRecord, as_table(StageRecord)], ...]


def _of_another_version(journal: Path) -> bool:
    """Whether the journal can be read, and is of another format version."""
    try:
        return bool(json.loads(journal.read_bytes()).get("format_version", FORMAT_VERSION) != FORMAT_VERSION)
    except (OSError, ValueError, AttributeError):
        return False


def file_digest(path: Path) -> str:
    """BLAKE2 of a file's content; of the stream the size, since each of its images has a checksum of its own."""
    if path.name in (IMAGES, JOURNAL):
        return f"{path.stat().st_size} bytes"
    with path.open("rb") as file:
        return hashlib.file_digest(file, hashlib.blake2b).hexdigest()


def _barely_begun(root: Path) -> bool:
    """Whether a folder without a journal is one that a run could not finish making (a full disk, a kill), or empty."""
    files = {"scene.toml", "scene.toml.part", "stages.json.part"}
    return all(path.name in files or (path.name in FOLDERS and not any(path.iterdir())) for path in root.iterdir())
