"""The command line. Errors that a user can mend are one line on stderr and exit status 2, never a traceback."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from disco_twin.cli.names import given
from disco_twin.cli.rig import ArmOption, LogsOption, rig_app
from hw.base.errors import DiscoError, InputError, naming, refused_by_the_disk
from pipeline.capture.loop import Interrupted

app = typer.Typer(
    help="A digital twin of the DISCO rig: simulate a laser capture, reconstruct R_d, relight, score.",
    add_completion=False,
    pretty_exceptions_enable=False,
)
console = Console()

SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="The scene's TOML file.", parser=given("SCENE"))]
RunOut = Annotated[Path, typer.Option("--out", metavar="DIR", help="The run folder.", parser=given("--out"))]
ProfileOption = Annotated[
    Literal["full", "small"], typer.Option(help="`small` shrinks the scene: fewer spots, pixels and walks.")
]
FaultsOption = Annotated[
    bool | None,
    typer.Option(
        "--faults/--no-faults",
        help="All rig faults of 2004 on (the pipeline then calibrates from the rig's images) or off; else the scene's.",
    ),
]
MethodsOption = Annotated[
    str | None, typer.Option(help="`all`, or a list such as default,disco2004; left out: the scene's.")
]
PLOTS = (".svg", ".png", ".pdf")
app.add_typer(rig_app, name="rig")


@app.command()
def run(
    scene: SceneFile,
    out: RunOut,
    profile: ProfileOption = "full",
    methods: MethodsOption = None,
    faults: FaultsOption = None,
) -> None:
    """Capture, reconstruct, relight and score; writes summary.json and report.html. The same command resumes."""
    from disco_twin.cli.tables import score_table
    from disco_twin.run.stages import begin_run, run_all

    with naming(scene):
        opened = begin_run(scene, out, profile, methods, console, faults)
        console.print(f"[bold]{opened.scene.name}[/bold] into {out}", highlight=False)
        summary = run_all(opened)
    console.print("", score_table(summary), sep="\n")
    console.print(f"\nreport: {opened.folder.report_file.resolve()}", soft_wrap=True, highlight=False)


@app.command()
def capture(
    scene: SceneFile,
    out: RunOut,
    profile: ProfileOption = "full",
    faults: FaultsOption = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            metavar="RIG.TOML", help="Capture with the devices of a rig file, not with the twin.", parser=given("--rig")
        ),
    ] = None,
    arm: ArmOption = False,
    logs: LogsOption = None,
) -> None:
    """Scan and capture only: DIR/capture is what the pipeline reads."""
    from disco_twin.run.device_capture import capture_with_devices
    from disco_twin.run.progress import run_log
    from disco_twin.run.stages import begin_run, capture_stages

    if rig is None and (arm or logs is not None):
        option = "--arm" if arm else "--logs"
        raise InputError("is for devices", key=option, remedy=f"name their rig file with --rig, or leave {option} out")
    with naming(scene):
        opened = begin_run(scene, out, profile, None, console, faults)
        with run_log(opened.folder.root / "run.log", console):
            if rig is None:
                capture_stages(opened)
            else:
                capture_with_devices(opened, rig, logs, armed=arm)


@app.command("import")
def import_(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="capture.toml, images.csv and 16-bit frames.", parser=given("FOLDER")),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="DIR", help="The capture that `python -m pipeline` reads.", parser=given("--out")
        ),
    ],
) -> None:
    """Turn a capture that was made without this software into ours. Needs no renderer."""
    from disco_twin.run.progress import screen_log, stage_bar
    from pipeline.capture.import_folder import import_capture

    with screen_log(console), stage_bar(console, "import", "images") as report:
        plan_ = import_capture(folder, out, report)
    console.print(f"{len(plan_)} images, {plan_.views} views, {len(plan_.spots)} spots", highlight=False)


@app.command()
def mesh(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A mesh or scan: PLY, OBJ or STL.", parser=given("IN"))],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The PLY file that is written.", parser=given("OUT"))],
    size_mm: Annotated[
        float | None, typer.Option(help="Scale it to this largest extent and centre it; left out, both are kept.")
    ] = None,
) -> None:
    """Close a mesh and orient it outward, and report what that changed. Needs no renderer."""
    from disco_twin.object.mesh_repair import mend

    for name, figure in mend(source, out, size_mm).lines():
        console.print(f"  {name:<12} {figure}", highlight=False, soft_wrap=True)


@app.command()
def quality(
    capture_folder: Annotated[
        Path, typer.Argument(metavar="CAPTURE", help="A capture: DIR/capture of a run.", parser=given("CAPTURE"))
    ],
) -> None:
    """Show the quality of a capture view by view, finished or not. Needs no renderer."""
    from disco_twin.cli.tables import quality_table
    from hw.base.config import read_json
    from pipeline.capture.poses import pose_warnings
    from pipeline.capture.quality import examine
    from pipeline.records import SensorFile
    from pipeline.stream.stream import StreamReader

    sensor = read_json(capture_folder / "sensor.json", SensorFile, "give the folder `capture` of a run").sensor
    with StreamReader(capture_folder) as stream:
        views = list(examine(stream, sensor))
    console.print(quality_table(views))
    for view in views:
        for remark in view.remarks:
            console.print(f"view {view.view}: {remark}", highlight=False, soft_wrap=True)
    for line in pose_warnings(capture_folder):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


@app.command()
def reconstruct(out: RunOut, methods: MethodsOption = None) -> None:
    """Reconstruct and relight a capture. Needs no renderer."""
    from disco_twin.run.progress import run_log
    from disco_twin.run.stages import pipeline_stage, reopen_run

    opened = reopen_run(out, methods, console)
    with naming(opened.scene_file), run_log(opened.folder.root / "run.log", console):
        pipeline_stage(opened)


@app.command()
def reference(scene: SceneFile, out: RunOut, profile: ProfileOption = "full") -> None:
    """Render the reference images of a scene into DIR, one EXR per light and held-out view."""
    from disco_twin.experiment.experiment import Experiment
    from disco_twin.experiment.references import render_references, shipped_references
    from disco_twin.run.progress import screen_log, stage_bar
    from disco_twin.run.scan import require_capturable
    from disco_twin.scene.scene import load_scene

    loaded = load_scene(scene, profile)
    with naming(scene), screen_log(console), stage_bar(console, "references", "lights") as report:
        experiment = Experiment(loaded)
        require_capturable(experiment)
        lights = render_references(experiment, shipped_references(scene, loaded.name), out, report)
    console.print(f"{lights} lights rendered, {len(loaded.relight.lights) - lights} were there", highlight=False)


@app.command()
def score(out: RunOut, methods: MethodsOption = None) -> None:
    """Score a finished run again and write its summary and report. Needs no renderer."""
    from disco_twin.cli.tables import score_table
    from disco_twin.run.progress import run_log
    from disco_twin.run.stages import reopen_run, score_stages

    opened = reopen_run(out, methods, console)
    with naming(opened.scene_file), run_log(opened.folder.root / "run.log", console):
        console.print("", score_table(score_stages(opened)), sep="\n")


@app.command()
def budget(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The folder of a finished run.", parser=given("OUT"))],
    methods: Annotated[str | None, typer.Option("--method", help="The method; left out: the scene's first.")] = None,
) -> None:
    """Show where a run's relighting error comes from: each part made exact in turn. Renders; minutes, kept in OUT."""
    from disco_twin.cli.tables import budget_tables
    from disco_twin.run.budget.make import make_budget
    from disco_twin.run.progress import run_log
    from disco_twin.run.stages import reopen_run

    opened = reopen_run(out, methods, console)
    with naming(opened.scene_file), run_log(opened.folder.root / "run.log", console):
        made = make_budget(opened)
    for table in budget_tables(made):
        console.print("", table, sep="\n")
    for what, why in made.left_out.items():
        console.print(f"no row for {what}: {why}", highlight=False, soft_wrap=True)
    console.print("Parts act on each other: what they cost need not add up in quadrature.", highlight=False)


@app.command()
def compare(
    first: Annotated[Path, typer.Argument(metavar="OUT1", help="A finished run.", parser=given("OUT1"))],
    second: Annotated[
        Path, typer.Argument(metavar="OUT2", help="Another one of the same capture.", parser=given("OUT2"))
    ],
    methods: Annotated[
        str, typer.Option(help="A method of both, or that of the first and that of the second: default,disco2004.")
    ] = "default",
    plot: Annotated[
        Path | None,
        typer.Option("--plot", metavar="FILE.svg", help="Draw it; .svg, .png or .pdf.", parser=given("--plot")),
    ] = None,
) -> None:
    """Compare two reconstructions of one capture, two methods or two versions of the code, figure by figure."""
    from disco_twin.cli.tables import difference_table
    from disco_twin.evaluate.compare import compare_runs

    names = [name.strip() for name in methods.split(",") if name.strip()]
    if len(names) not in (1, 2):
        raise InputError(
            "names no method or too many", key="--methods", value=methods, allowed="one method, or two",
            remedy="default,disco2004 compares the first's default with the second's disco2004",
        )  # fmt: skip
    if plot is not None and plot.suffix not in PLOTS:
        raise InputError(
            "is no kind of picture that can be drawn", key="--plot", value=str(plot), allowed=", ".join(PLOTS),
            remedy=f"{plot.stem}.svg",
        )  # fmt: skip
    differences = compare_runs(first, second, (names[0], names[-1]))
    shown = (names[0], names[1]) if len(names) == 2 else (first.resolve().name, second.resolve().name)
    if shown[0] == shown[1]:
        shown = "first", "second"
    console.print(difference_table(differences, *shown))
    console.print("Errors, so more is worse; by: of the second; +-: standard error.", highlight=False)
    if plot is not None:
        from disco_twin.report.differences import write_differences

        write_differences(plot, differences, *shown)
        console.print(f"plot: {plot.resolve()}", soft_wrap=True, highlight=False)


@app.command()
def view(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The folder of a finished run.", parser=given("OUT"))],
    file: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE.html", help="Left out: view.html in OUT.", parser=given("--out")),
    ] = None,
    method: Annotated[str | None, typer.Option("--method", help="The method; left out: the first.")] = None,
    rank: Annotated[int | None, typer.Option("--rank", min=1, help="Of the far part; lower is smaller.")] = None,
) -> None:
    """Write a page in which the object is relit by hand: one file, opened by any browser. Needs no renderer."""
    from disco_twin.experiment.run_folder import RunFolder
    from disco_twin.view.page import write_page

    folder = RunFolder.open(out)
    path = folder.view_file if file is None else file
    size = write_page(folder, path, method, rank)
    console.print(f"page: {path.resolve()} ({size:.1f} MB)", soft_wrap=True, highlight=False)


@app.command()
def plan(scene: SceneFile, profile: ProfileOption = "full") -> None:
    """Predict images, bytes and time of a scene, and list what it leaves out. Needs no renderer."""
    from disco_twin.experiment.experiment import Experiment
    from disco_twin.experiment.references import shipped_references
    from disco_twin.run.cost_prediction import predict
    from disco_twin.run.progress import screen_log
    from disco_twin.run.scan import require_capturable
    from disco_twin.scene.scene import load_scene

    with naming(scene), screen_log(console):
        experiment = Experiment(load_scene(scene, profile))
        require_capturable(experiment)
        lines = predict(experiment, shipped_references(scene, experiment.scene.name))
        lines += [("warning", line) for line in experiment.warnings]
    for name, value in lines:
        console.print(f"  {name:<12} {value}", highlight=False, soft_wrap=True)


@app.command()
def doctor() -> None:
    """Check the installation: versions, LLVM, a small render, memory, disk. Exit status 1 if something is missing."""
    from disco_twin.cli.doctor import examine

    findings = examine(Path.cwd())
    for finding in findings:
        console.print(str(finding), highlight=False, markup=False, soft_wrap=True)
    if not all(f.good for f in findings):
        raise typer.Exit(1)


def main(arguments: list[str] | None = None) -> Any:
    """Entry point of `disco-twin`."""
    words = sys.argv[1:] if arguments is None else arguments
    try:
        status = app(words or ["--help"], prog_name="disco-twin", standalone_mode=False)
    except Interrupted as error:
        return _stop(str(error), 130)
    except typer.Abort:
        return _stop("stopped; the same command continues", 130)
    except DiscoError as error:
        return _stop(str(error), 2)
    except OSError as error:
        known = refused_by_the_disk(error, Path())
        reason = f"{error.filename or 'input or output'}: {error.strerror or error}"
        return _stop(str(known or f"{reason}. Remedy: correct the path, repeat the same command"), 2)
    except MemoryError:
        return _stop("not enough memory. Remedy: fewer pixels, spots or scan.vertices, or a machine with more", 2)
    except Exception as error:
        if not hasattr(error, "format_message"):  # of wrong options and arguments; where its class lies, typer changes
            raise
        context = getattr(error, "ctx", None)
        command = "disco-twin" if context is None else context.command_path
        problem = str(error.format_message()).rstrip(".?")
        return _stop(f"{problem}. Remedy: `{command} --help` lists what is allowed", 2)
    sys.exit(status if isinstance(status, int) else 0)


def _stop(message: str, status: int) -> None:
    line = " ".join(message.splitlines())
    Console(stderr=True).print(f"disco-twin: {line}", style="red", highlight=False, markup=False, soft_wrap=True)
    sys.exit(status)


if __name__ == "__main__":
    main()
