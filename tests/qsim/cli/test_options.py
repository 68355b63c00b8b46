"""Tests that every option of `qsim` acts or is refused; a new option needs its row."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from clips import colour_clip, write_clip
from option_rows import (
    Acts,
    Refused,
    Row,
    arrays,
    check,
    exit_code,
    loudness,
    names,
    numbers,
    options,
    stdout,
    threads,
)

import qsim.cli.program
from qsim.cli.program import main
from qsim.cli.validate import ACTING
from qsim.optics.camera import Camera
from qsim.scene.camera_path import write_camera_path

RENDER = "render fan --frames 2 --height 16 --width 24 --psnr 20"
STILL = "render still.py --frames 2 --height 16 --width 24 --psnr 20 -o r"
CODES = "convert codes.npy c --layout codes --bits 3 --frame-rate 9"
PLANES = "convert lit.npy c --layout codes --bits 1 --frame-rate 9"
LIGHT = "convert light.npy c --transfer linear --frame-rate 9"
CALIBRATE = "calibrate --model spad --bits 1 --dark planes.npy 1e-5 --flat lit.npy 1e-5 -o s.toml"
QIS = "calibrate --bits 3 --dark q0.npy 1e-3 --dark q1.npy 0.2 --flat q2.npy 1e-3 --flat q3.npy 1e-3 -o s.toml"
ENGINES = "validate engines --scenes fan --height 16 --width 24"
STUDY = "tradeoff fast --ppp 3 --bits 1,2 --json"
WORDS = {  # a line that each parser takes
    "doctor": "doctor",
    "render": f"{RENDER} -o r",
    "sense": "sense clip",
    "generate": "generate t.toml -o d",
    "plan": "plan t.toml",
    "check": "check clip",
    "recipes": "recipes",
    "sensors": "sensors",
    "demo": "demo t.toml",
    "convert": CODES,
    "preview": "preview clip",
    "report": "report clip",
    "explore": "explore clip",
    "tradeoff": "tradeoff --table",
    "compare": "compare clip",
    "calibrate": QIS,
    "validate": "validate reading",
    "completion": "completion bash",
}
# Values of reading options that a .npy of codes, and the stacks of a calibration, refuse: they have their own layout.
LAYOUTS = {
    "order": "msb",
    "endian": "little",
    "skip-bytes": "3",
    "row-padding": "2",
    "channel": "1",
    "slice": "1",
    "dataset": "a",
    "variable": "b",
    "height": "4",
    "width": "4",
}
VALIDATE = {"output": "x.png", "pixels": "65536", "scenes": "fan", "height": "24", "width": "32", "psnr": "30"}


def fail_once(folder: Path) -> None:
    """A data set whose only job has failed, for a reason that is gone now."""
    assert main(["generate", "broken.toml", "-o", "d", "--workers", "0", "-q"]) == 1
    (folder / "ready").mkdir()


def damage(folder: Path) -> None:
    """A data set of which one file of light is gone."""
    assert main(["generate", "t.toml", "-o", "d", "--workers", "0", "-q"]) == 0
    next(folder.glob("d/clips/*/radiance/*.exr")).unlink()


def validate(option: str, *acts: Row) -> list[Row]:
    """The rows of an option of `validate`: refused wherever the table of the command does not name it."""
    word = f"--{option.replace('_', '-')} {VALIDATE.get(option, '')}".strip()
    return [*acts, *(Refused(f"validate {w}", word, word.split()[0]) for w, own in ACTING.items() if option not in own)]


ROWS: dict[tuple[str, str], list[Row]] = {
    ("", "--version"): [Acts("", "--version", stdout)],
    **loudness(WORDS),
    **{
        (name, "--json"): [Acts(line, "--json", stdout)]
        for name, line in WORDS.items()
        if name not in ("render", "generate", "plan", "calibrate", "validate", "demo")
    },
    ("render", "--json"): [Acts(f"{RENDER} -o r", "--json", stdout, slow=True)],
    ("generate", "--json"): [Acts("generate t.toml -o d --workers 0", "--json", stdout, slow=True)],
    ("plan", "--json"): [Acts("plan t.toml", "--json", stdout, slow=True)],
    ("calibrate", "--json"): [Acts(CALIBRATE, "--json", stdout)],
    ("validate", "--json"): [Acts(ENGINES, "--json", stdout, slow=True)],
    ("demo", "--json"): [Acts("demo t.toml", "--json", stdout, codes=(2,))],
    ("recipes", "--print"): [Acts("recipes", "--print demo", stdout), Refused("recipes", "--print none", "no such")],
    ("recipes", "--keys"): [
        Acts("recipes", "--keys", stdout),
        Refused("recipes --print demo", "--keys", "not allowed with"),
    ],
    ("sensors", "--keys"): [Acts("sensors", "--keys", stdout)],
    ("doctor", "--devices"): [Acts("doctor", "--devices", stdout)],
    # render
    ("render", "--threads"): [Acts(f"{RENDER} -o r", "--threads 1", threads, slow=True)],
    ("render", "--output"): [
        Acts(f"{RENDER} --explain", "-o r", names, slow=True),
        Refused(RENDER, "-o clip", "exists"),
    ],
    ("render", "--explain"): [Acts(f"{RENDER} -o r", "--explain", stdout, slow=True)],
    ("render", "--seed"): [Acts(f"{RENDER} -o r", "--seed 3", slow=True), Refused(RENDER, "--seed -1", "seed")],
    ("render", "--speed"): [Acts(f"{RENDER} -o r", "--speed 3", slow=True), Refused(STILL, "--speed 3", "speed")],
    ("render", "--frames"): [Acts(f"{RENDER} -o r", "--frames 3", names, slow=True)],
    ("render", "--height"): [Acts(f"{RENDER} -o r", "--height 12", slow=True)],
    ("render", "--width"): [Acts(f"{RENDER} -o r", "--width 12", slow=True)],
    ("render", "--frame-rate"): [Acts(f"{RENDER} -o r", "--frame-rate 240", slow=True)],
    ("render", "--shutter"): [Acts(f"{RENDER} -o r", "--shutter 1", names, slow=True)],
    ("render", "--bands"): [
        Acts(f"{RENDER} -o r", "--bands rgb", slow=True),
        Refused(RENDER, "--bands grey", "--bands"),
    ],
    ("render", "--camera-path"): [
        Acts(f"{RENDER} -o r", "--camera-path path.json", slow=True),
        Refused(f"{RENDER} -o r", "--camera-path none.json", "no such file"),
    ],
    ("render", "--psnr"): [Acts(f"{RENDER} -o r", "--psnr 34", slow=True), Refused(RENDER, "--psnr 5", "psnr")],
    ("render", "--ppp"): [Acts(f"{RENDER} -o r", "--ppp 3000", slow=True)],
    ("render", "--reuse"): [
        Acts(f"{RENDER} -o r", "--reuse", stdout, slow=True),
        Refused(f"{RENDER} -o r --no-reuse", "--reuse", "--reuse"),
    ],
    ("render", "--no-reuse"): [Acts(f"{RENDER} --explain", "--no-reuse", stdout, slow=True)],
    ("render", "--engine"): [Acts(f"{RENDER} -o r", "--engine scalar", slow=True)],
    ("render", "--force"): [
        Acts(f"{RENDER} -o clip", "--force", exit_code, codes=(0, 2), slow=True),
        Refused(f"{RENDER} --explain", "--force", "--force"),
    ],
    # sense
    ("sense", "--threads"): [Acts("sense wide", "--threads 1", threads)],
    ("sense", "--sensor"): [
        Acts("sense clip", "--sensor spad-320x240"),
        Refused("sense clip", "--sensor no", "sensor"),
    ],
    ("sense", "--bits"): [
        Acts("sense clip --name n", "--bits 2"),
        Refused("sense clip --sensor my.toml", "--bits 5", "bits"),
    ],
    ("sense", "--ppp"): [Acts("sense clip --name n", "--ppp 9"), Refused("sense clip --lux 1", "--ppp 9", "not both")],
    ("sense", "--lux"): [
        Acts("sense clip --name n", "--lux 0.3"),
        Refused("sense clip --ppp 1", "--lux 9", "not both"),
    ],
    ("sense", "--pixel-pitch"): [
        Acts("sense relative --lux 1 --name n", "--pixel-pitch 1.1e-6", codes=(0, 2)),
        Refused("sense clip --lux 1", "--pixel-pitch 2e-6", "its camera has pixels of"),
        Refused("sense relative --lux 1", "--pixel-pitch 1.1", "--pixel-pitch is in metres, got 1.1"),
        Refused("sense clip --replay clip:1", "--pixel-pitch 1e-6", "draws what is stored"),
    ],
    ("sense", "--seed"): [Acts("sense clip --name n", "--seed 4")],
    ("sense", "--name"): [Acts("sense clip", "--name other", names)],
    ("sense", "--group"): [
        Acts("sense clip --sensor spad-320x240 --bits 2 --name n", "--group"),
        Refused("sense clip --bits 3", "--group", "planes"),
    ],
    ("sense", "--diffraction"): [
        Acts("sense clip --name n", "--diffraction"),
        Refused("sense relative --ppp 3", "--diffraction", "camera"),
    ],
    ("sense", "--defects"): [
        Acts("sense clip --name n", "--defects bad.toml"),
        Refused("sense clip", "--defects no.toml", "no.toml"),
    ],
    ("sense", "--colour"): [
        Acts("sense coloured", "--colour rggb", codes=(0, 2)),
        Refused("sense clip", "--colour rggb", "colour filters"),
    ],
    ("sense", "--slices"): [
        Acts("sense clip --sensor counter.toml --name n", "--slices 2"),
        Acts("sense clip --name n", "--slices 2"),
        Refused("sense clip --sensor spad-320x240", "--slices 2", "slices"),
    ],
    ("sense", "--row-delay"): [
        Acts("sense clip --ppp 3 --name n", "--row-delay 1e-6"),
        Refused("sense clip", "--row-delay 1", "longer than a frame"),
    ],
    ("sense", "--row-order"): [
        Acts("sense clip --ppp 3 --name n --row-delay 1e-6", "--row-order left"),
        Refused("sense clip", "--row-order up", "give row_delay"),
    ],
    ("sense", "--exposures"): [
        Acts("sense clip --ppp 3 --name n", "--exposures 1,0.25"),
        Refused("sense clip", "--exposures 1,2", "exposures: expected"),
    ],
    ("sense", "--follow"): [
        Acts("sense clip --sensor counter.toml --ppp 3 --name n", "--follow"),
        Refused("sense clip", "--follow", "followed"),
    ],
    ("sense", "--light-drift"): [Refused("sense clip --replay clip:1", "--light-drift 0.2", "draws what is stored")],
    ("sense", "--temperature"): [
        Refused("sense clip", "--temperature 20", "no law of temperature"),
        Refused("sense clip --replay clip:1", "--temperature 20", "draws what is stored"),
    ],
    ("sense", "--replay"): [
        Acts("sense clip --ppp 3.25 --bits 3", "--replay clip:1", stdout, before="sense clip --ppp 3.25 --bits 3"),
        Refused("sense clip --replay clip:1", "--ppp 3.25,26", "2 light levels"),
        Refused("sense clip --replay clip:1", "--row-order up", "give row_delay"),
        *(
            Refused("sense clip --replay clip:1", option, option.split()[0])
            for option in (
                "--group",
                "--follow",
                "--diffraction",
                "--defects bad.toml",
                "--slices 2",
                "--row-delay 1e-6",
                "--exposures 1,0.5",
                "--force",
            )
        ),
        *(
            Refused("sense clip --replay clip:1", option, "no stream")
            for option in ("--ppp 77", "--bits 7", "--sensor spad-320x240", "--seed 5", "--lux 2", "--name x")
        ),
        *(
            Refused("sense clip --name s --replay clip:1", option, option.split()[0])
            for option in ("--ppp 77", "--bits 7", "--sensor b", "--seed 5", "--lux 2", "--colour rggb")
        ),
    ],
    ("sense", "--force"): [Acts("sense clip --name s --seed 9", "--force", codes=(0, 2))],
    # generate, plan, check
    ("generate", "--threads"): [
        Refused("generate t.toml -o d --cluster tcp://127.0.0.1:1", "--threads 1", "--threads")
    ],
    ("generate", "--output"): [Refused("generate t.toml", "-o clip", "not a data set")],
    ("generate", "--workers"): [
        Refused("generate t.toml -o d --cluster tcp://127.0.0.1:1", "--workers 1", "--workers"),
    ],
    ("generate", "--shard"): [Acts("generate t.toml -o d --workers 0", "--shard 1/2", slow=True)],
    ("generate", "--memory"): [
        Refused("generate t.toml -o d --workers 0", "--memory 2", "--memory"),
        Refused("generate t.toml -o d --cluster tcp://127.0.0.1:1", "--memory 2", "--memory"),
    ],
    ("generate", "--retry"): [
        Acts("generate broken.toml -o d --workers 0", "--retry", exit_code, codes=(0, 1), before=fail_once, slow=True)
    ],
    ("generate", "--repair"): [
        Acts("generate t.toml -o d --workers 0", "--repair", names, codes=(0, 1), before=damage, slow=True)
    ],
    ("generate", "--wait"): [Refused("generate t.toml -o clip", "--wait", "not a data set")],
    ("generate", "--cluster"): [Refused("generate t.toml -o d", "--cluster nowhere", "nowhere")],
    ("generate", "--gpus"): [Refused("generate t.toml -o d", "--gpus 1", "--gpus")],
    ("plan", "--threads"): [Acts("plan t.toml", "--threads 1", threads, slow=True)],
    ("plan", "--machines"): [Acts("plan t.toml --json", "--machines 4", numbers("machines"), slow=True)],
    ("plan", "--frames"): [Refused("plan t.toml", "--frames 1", "frames")],
    ("plan", "--shard"): [Acts("plan t.toml", "--shard 2/2", stdout, slow=True)],
    ("check", "--redraw"): [Acts("check clip", "--redraw", stdout)],
    # compare
    ("compare", "--streams"): [
        Acts("compare clip", "--streams s", stdout),
        Refused("compare clip", "--streams x", "x"),
    ],
    ("compare", "--span"): [Acts("compare clip", "--span 1e-3", stdout), Refused("compare clip", "--span 9", "span")],
    # convert
    ("convert", "--layout"): [Acts("convert codes.npy c --frame-rate 9", "--layout cube", exit_code, codes=(0, 2))],
    ("convert", "--frame-rate"): [
        Refused("convert clip e.mp4", "--frame-rate 9", "--frame-rate"),
        Acts("convert codes.npy c --layout codes --bits 3", "--frame-rate 9", exit_code, codes=(0, 2)),
    ],
    ("convert", "--exposure"): [
        Acts(LIGHT, "--exposure 0.001", after="sense c --ppp 3 --bits 3"),
        Refused("convert clip e.mp4", "--exposure 1", "--exposure"),
    ],
    ("convert", "--transfer"): [
        Acts("convert clip e --to png", "--transfer linear"),
        Refused(CODES, "--transfer linear", "--transfer"),
        Refused("convert clip e --to exr", "--transfer linear", "--transfer"),
        Refused("convert clip/streams/s.json e --to png", "--transfer linear", "--transfer"),
    ],
    ("convert", "--height"): [
        Acts("convert spikes.dat c --layout spike --width 8 --frame-rate 9", "--height 16", exit_code, codes=(0, 2)),
        Refused(CODES, "--height 4", "--height"),
        Refused("convert clip e.mp4", "--height 4", "--height"),
    ],
    ("convert", "--width"): [
        Acts("convert cube.npy c --layout cube --frame-rate 9", "--width 13"),
        Refused(CODES, "--width 4", "--width"),
        Refused("convert clip e.mp4", "--width 4", "--width"),
    ],
    ("convert", "--bits"): [
        Acts(CODES.replace("--bits 3", ""), "--bits 5", exit_code, codes=(0, 2)),
        Refused("convert cube.npy c --layout cube --frame-rate 9", "--bits 2", "--bits"),
        Refused(LIGHT, "--bits 2", "--bits"),
        Refused("convert clip e.mp4", "--bits 2", "--bits"),
    ],
    ("convert", "--stretched"): [
        Acts("convert stretched c --bits 2 --frame-rate 9", "--stretched", arrays, codes=(0, 2)),
        Refused(CODES, "--stretched", "stretched"),
        Refused("convert clip e.mp4", "--stretched", "--stretched"),
    ],
    ("convert", "--channel"): [
        Acts("convert colour.npy c --layout cube --frame-rate 9", "--channel 1", exit_code, codes=(0, 2)),
        Refused(CODES, "--channel 1", "--channel"),
        Refused("convert clip e.mp4", "--channel 1", "--channel"),
    ],
    ("convert", "--flip"): [Acts(CODES, "--flip ud"), Refused("convert clip e.mp4", "--flip ud", "--flip")],
    ("convert", "--columns"): [Acts(CODES, "--columns 5"), Refused("convert clip e.mp4", "--columns 5", "--columns")],
    ("convert", "--variable"): [
        Acts("convert two.mat c --frame-rate 9", "--variable b", exit_code, codes=(0, 2)),
        Refused(CODES, "--variable b", "--variable"),
        Refused("convert clip e.mp4", "--variable b", "--variable"),
    ],
    ("convert", "--sensor"): [
        Acts(CODES, "--sensor no-such", exit_code, codes=(0, 2)),
        Refused(LIGHT, "--sensor spad-320x240", "--sensor"),
        Refused("convert clip e.mp4", "--sensor spad-320x240", "--sensor"),
    ],
    ("convert", "--ppp"): [
        Refused(CODES, "--ppp 3", "--ppp"),
        Refused(LIGHT, "--ppp 3", "--ppp"),
        Refused("convert clip e.mp4", "--ppp 3", "--ppp"),
    ],
    ("convert", "--split"): [
        Refused(CODES, "--split test", "--split"),
        Refused("convert clip e.mp4", "--split test", "--split"),
    ],
    ("convert", "--to"): [
        Acts("convert clip e", "--to png", exit_code, codes=(0, 2)),
        Acts("convert clip e.mp4", "--to png", names),
        Refused(CODES, "--to png", "--to"),
    ],
    ("convert", "--planes"): [
        Acts(PLANES, "--planes 7"),
        Acts("convert clip/streams/b.npy e", "--planes 3", codes=(0, 2)),
        Refused(CODES, "--planes 7", "--planes"),
        Refused(LIGHT, "--planes 7", "is light"),
        Refused("convert clip e", "--planes 7", "name one of its streams"),
    ],
    ("convert", "--from"): [
        Acts(PLANES, "--from 7"),
        Refused(PLANES, "--from 400", "has planes 0..399"),
        Refused(LIGHT, "--from 1", "is light"),
    ],
    ("convert", "--until"): [
        Acts(PLANES, "--until 7"),
        Refused(LIGHT, "--until 1", "is light"),
    ],
    ("convert", "--every"): [
        Acts(PLANES, "--every 7"),
        Refused(f"{PLANES} --planes 7", "--every 3", "would share planes"),
        Refused(LIGHT, "--every 2", "is light"),
    ],
    ("convert", "--window"): [
        Acts("convert clip e.h5", "--window 2", stdout),
        Acts("convert bands e --to challenge", "--window 2", codes=(0, 2)),
        Refused("convert clip e --to png", "--window 2", "--window"),
        Refused(CODES, "--window 2", "--window"),
    ],
    ("convert", "--lossy"): [
        Acts("convert clip e.mp4", "--lossy"),
        Refused("convert clip e --to png", "--lossy", "--lossy"),
        Refused(CODES, "--lossy", "--lossy"),
    ],
    ("convert", "--white"): [
        Acts("convert clip e --to png", "--white 0.5"),
        Acts(LIGHT, "--white 30000", names),
        Refused("convert clip e --to exr", "--white 0.5", "--white"),
        Refused(CODES, "--white 0.5", "--white"),
    ],
    ("convert", "--force"): [Acts(f"{CODES} --flip ud", "--force", codes=(0, 2), before=CODES)],
    ("convert", "--axes"): [
        Acts(CODES, "--axes HTW"),
        Refused("convert clip e.mp4", "--axes TYX", "--axes"),
    ],
    ("convert", "--black"): [Acts(LIGHT, "--black 0.25"), Refused(CODES, "--black 0.25", "--black")],
    ("convert", "--keep-gaps"): [Refused(CODES, "--keep-gaps", "--keep-gaps")],
    **{
        ("convert", f"--{name}"): [
            Refused(CODES, f"--{name} {value}", f"--{name}"),
            Refused("convert clip e.mp4", f"--{name} {value}", f"--{name}"),
        ]
        for name, value in LAYOUTS.items()
        if name in ("order", "endian", "skip-bytes", "row-padding", "slice", "dataset")
    },
    # preview, report
    ("preview", "--output"): [Acts("preview clip", "-o p.png", names)],
    ("preview", "--what"): [
        Acts("preview clip", "--what average", stdout),
        Refused("preview relative", "--what flow", "flow"),
    ],
    ("preview", "--stream"): [
        Acts("preview clip --what codes", "--stream s", stdout),
        Refused("preview clip --what sharp", "--stream s", "--stream"),
        Refused("preview light.npy", "--stream s", "--stream"),
    ],
    ("preview", "--frame"): [
        Acts("preview clip", "--frame 0", stdout),
        Refused("preview clip --play", "--frame 1", "--frame"),
    ],
    ("preview", "--fps"): [Acts("preview clip -o p.gif", "--fps 50"), Refused("preview clip", "--fps 9", "--fps")],
    ("preview", "--scale"): [
        Acts("preview clip -o p.png", "--scale 3"),
        Refused("preview clip", "--scale 3", "--scale"),
    ],
    ("preview", "--bits"): [
        Acts("preview codes.npy", "--bits 3", stdout, codes=(0, 2)),
        Refused("preview clip", "--bits 3", "--bits"),
    ],
    ("preview", "--width"): [
        Acts("preview cube.npy", "--width 13", stdout, codes=(0, 2)),
        Refused("preview clip", "--width 3", "--width"),
    ],
    ("preview", "--planes"): [
        Acts("preview planes.npy --bits 1", "--planes 4", stdout),
        Refused("preview clip", "--planes 4", "is a clip"),
        Refused("preview codes.npy --bits 3", "--planes 2", "--planes"),
    ],
    ("preview", "--from"): [
        Acts("preview planes.npy --bits 1", "--from 9", stdout),
        Refused("preview clip", "--from 1", "is a clip"),
    ],
    ("preview", "--to"): [
        Acts("preview planes.npy --bits 1", "--to 9", stdout),
        Refused("preview clip", "--to 1", "is a clip"),
    ],
    ("preview", "--every"): [
        Acts("preview planes.npy --bits 1", "--every 9", stdout),
        Refused("preview clip", "--every 2", "is a clip"),
    ],
    ("preview", "--play"): [
        Acts("preview clip --fps 1000", "--play", exit_code, codes=(0, 2)),
        Refused("preview clip -o p.gif", "--play", "--play"),
    ],
    ("preview", "--force"): [
        Acts("preview clip -o p.png --frame 1", "--force", codes=(0, 2), before="preview clip -o p.png --frame 0"),
        Refused("preview clip", "--force", "--force"),
    ],
    ("explore", "--output"): [Acts("explore clip", "-o x.html", names)],
    ("explore", "--force"): [Acts("explore clip -o x.html", "--force", codes=(0, 2), before="report clip -o x.html")],
    ("report", "--output"): [Acts("report clip", "-o x.html", names)],
    ("report", "--title"): [Acts("report clip", "--title Mine")],
    ("report", "--note"): [Acts("report clip", "--note Mine")],
    ("report", "--force"): [Acts("report clip --title B", "--force", codes=(0, 2), before="report clip --title A")],
    # tradeoff
    ("tradeoff", "--threads"): [
        Refused(STUDY, "--threads 0", "--threads"),
        Acts("tradeoff wide --ppp 3 --bits 1,2", "--threads 1", threads),
    ],
    ("tradeoff", "--table"): [Acts(STUDY, "--table", exit_code, codes=(0, 2)), Refused(STUDY, "--table", "leave")],
    ("tradeoff", "--paper-figure"): [Refused(f"{STUDY}", "--paper-figure 1", "changes nothing")],
    ("tradeoff", "--size"): [
        Acts("tradeoff --table", "--size 64x64", stdout),
        Refused(STUDY, "--size 64x64", "--size"),
    ],
    ("tradeoff", "--base-fps"): [
        Acts("tradeoff --table", "--base-fps 500", stdout),
        Refused(STUDY, "--base-fps 9", "--base-fps"),
    ],
    ("tradeoff", "--read-noise"): [
        Acts("tradeoff --table", "--read-noise 1", stdout),
        Refused(STUDY, "--read-noise 1", "--read-noise"),
    ],
    ("tradeoff", "--motion"): [
        Acts("tradeoff --table", "--motion 3", stdout),
        Refused(STUDY, "--motion 3", "--motion"),
    ],
    ("tradeoff", "--bits"): [
        Acts("tradeoff --table", "--bits 1,3", stdout),
        Refused("tradeoff fast --paper-figure 1", "--bits 3", "--bits"),
    ],
    ("tradeoff", "--ppp"): [
        Acts("tradeoff fast --bits 1,2 --json", "--ppp 9", stdout),
        Refused("tradeoff --table", "--ppp 9", "--ppp"),
    ],
    ("tradeoff", "--speed"): [Acts(STUDY, "--speed 2", stdout), Refused("tradeoff --table", "--speed 2", "--speed")],
    ("tradeoff", "--px"): [
        Acts(STUDY, "--px 3", stdout, codes=(0, 2)),
        Refused("tradeoff --table", "--px 2", "--px"),
        Refused(f"{STUDY} --speed 2", "--px 2", "--speed"),
    ],
    ("tradeoff", "--sensor"): [
        Acts(STUDY, "--sensor spad-320x240", stdout),
        Refused("tradeoff --table", "--sensor x", "--sensor"),
    ],
    ("tradeoff", "--plane-sensor"): [
        Acts(STUDY, "--plane-sensor spad-320x240", stdout),
        Refused("tradeoff --table", "--plane-sensor x", "--plane-sensor"),
    ],
    ("tradeoff", "--temperature"): [
        Refused(STUDY, "--temperature 20", "no law of temperature"),
        Refused("tradeoff --table", "--temperature 20", "--temperature"),
    ],
    ("tradeoff", "--instants"): [
        Acts(STUDY, "--instants 1", stdout, codes=(0, 2)),
        Refused("tradeoff --table", "--instants 2", "--instants"),
    ],
    ("tradeoff", "--frames"): [
        Refused(STUDY, "--frames 4", "--frames"),
        Refused("tradeoff --table", "--frames 4", "--frames"),
    ],
    ("tradeoff", "--seed"): [Acts(STUDY, "--seed 4", stdout), Refused("tradeoff --table", "--seed 4", "--seed")],
    ("tradeoff", "--streams"): [
        Refused(STUDY, "--streams", "-o"),
        Refused("tradeoff --table", "--streams", "--streams"),
    ],
    ("tradeoff", "--output"): [Acts(STUDY, "-o st", names), Refused("tradeoff --table", "-o st", "output")],
    ("tradeoff", "--force"): [Refused(STUDY, "--force", "--force"), Refused("tradeoff --table", "--force", "--force")],
    # calibrate
    ("calibrate", "--dark"): [
        Acts("calibrate --model spad --bits 1 --flat lit.npy 1e-5 -o s.toml", "--dark planes.npy 1e-5"),
        Refused("calibrate --bits 8 --static counts.npy 1e-5 -o s.toml", "--dark planes.npy 1e-5", "--static"),
    ],
    ("calibrate", "--flat"): [
        Acts("calibrate --model spad --bits 1 --dark planes.npy 1e-5 -o s.toml", "--flat lit.npy 1e-5 0.8"),
        Refused("calibrate --bits 8 --static counts.npy 1e-5 -o s.toml", "--flat planes.npy 1e-5", "--static"),
    ],
    ("calibrate", "--static"): [Refused(CALIBRATE, "--static counts.npy 1e-5", "--static")],
    ("calibrate", "--bits"): [
        Acts(CALIBRATE, "--bits 2", codes=(0, 2)),
        Refused("calibrate --planes 50 --dark sums.npy 1e-5 -o s.toml", "--bits 6", "--bits"),
    ],
    ("calibrate", "--planes"): [
        Acts(
            "calibrate --model spad --dark sums.npy 1e-5 --bits 8 -o s.toml".replace("--bits 8", ""),
            "--planes 50",
            exit_code,
            codes=(0, 2),
        ),
        Refused(QIS.replace("calibrate", "calibrate --model qis"), "--planes 50", "--planes"),
    ],
    ("calibrate", "--from"): [
        Acts(CALIBRATE, "--from 100", stdout),
        Refused("calibrate --bits 8 --static counts.npy 1e-5 -o s.toml", "--from 9", "--static"),
    ],
    ("calibrate", "--to"): [
        Acts(CALIBRATE, "--to 300", stdout),
        Refused("calibrate --bits 8 --static counts.npy 1e-5 -o s.toml", "--to 9", "--static"),
    ],
    ("calibrate", "--every"): [
        Acts(CALIBRATE, "--every 2", stdout),
        Refused("calibrate --bits 8 --static counts.npy 1e-5 -o s.toml", "--every 9", "--static"),
    ],
    ("calibrate", "--model"): [Refused("calibrate --bits 8 --static counts.npy 1e-5 -o s.toml", "--model qis", "qis")],
    ("calibrate", "--paralyzable"): [
        Refused(CALIBRATE, "--paralyzable", "dead time"),
        Refused(QIS, "--paralyzable", "spad"),
    ],
    ("calibrate", "--ignore-dead-time"): [
        Refused(QIS, "--ignore-dead-time", "spad"),
        Refused(CALIBRATE, "--ignore-dead-time", "dead"),
    ],
    ("calibrate", "--layout"): [Refused(QIS, "--layout cube", "cube")],
    ("calibrate", "--axes"): [Refused(QIS, "--axes HTWC", "axes")],
    **{("calibrate", f"--{name}"): [Refused(QIS, f"--{name} {value}", f"--{name}")] for name, value in LAYOUTS.items()},
    ("calibrate", "--output"): [Refused(CALIBRATE.removesuffix(" -o s.toml"), "-o t.txt", ".toml")],
    ("calibrate", "--force"): [Acts(CALIBRATE, "--force", exit_code, codes=(0, 2), before=CALIBRATE)],
    # validate
    ("validate", "--threads"): [Acts(ENGINES, "--threads 1", threads, slow=True)],
    ("validate", "--output"): validate("output"),
    ("validate", "--pixels"): validate("pixels"),
    ("validate", "--seed"): [Refused("validate sensor", "--seed -1", "seed")],
    ("validate", "--require-speed"): validate("require_speed"),  # its exit codes: test_validate.py
    ("validate", "--scenes"): validate("scenes"),
    ("validate", "--height"): validate("height"),
    ("validate", "--width"): validate("width"),
    ("validate", "--psnr"): validate("psnr"),
    ("validate", "--force"): [*validate("force"), Refused("validate sensor", "--force", "--force")],
}


@pytest.fixture(scope="session")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the rows name."""
    from PIL import Image
    from scipy.io import savemat

    folder = tmp_path_factory.mktemp("work")
    rng = np.random.default_rng(0)
    flow = np.stack([np.full((16, 24), 1.5), np.zeros((16, 24))])
    clip = write_clip(folder / "clip", frames=16, height=16, width=24)
    assert main(["sense", str(clip.path), "--ppp", "3.25", "--bits", "3", "--name", "s", "-q"]) == 0
    assert main(["sense", str(clip.path), "--sensor", "spad-320x240", "--name", "b", "-q"]) == 0
    write_clip(folder / "fast", frames=16, height=16, width=24, frame_rate=20000.0, exposure=5e-5, flow=flow)
    write_clip(folder / "wide", frames=16, height=64, width=96, frame_rate=20000.0, exposure=5e-5)
    write_clip(folder / "relative", frames=3, height=16, width=24, relative=True)
    bands = write_clip(folder / "bands", frames=6, height=5, width=9)
    for seed, name in enumerate(("red", "green", "blue")):
        bands.sense("spad512s", ppp=0.4, bits=1, seed=seed, name=name)
    colour_clip(folder / "coloured")
    write_camera_path(folder / "path.json", Camera(2e-4, 2.8, 1e-5, 16, 24, origin=(0, 0, 3)), frames=2, frame_rate=2e3)
    np.save(folder / "codes.npy", rng.integers(0, 4, (3, 16, 24)).astype(np.uint8))
    np.save(folder / "light.npy", rng.integers(0, 60000, (3, 16, 24)).astype(np.uint16))
    np.save(folder / "cube.npy", rng.integers(0, 256, (3, 16, 2)).astype(np.uint8))
    np.save(folder / "colour.npy", rng.integers(0, 256, (3, 16, 2, 3)).astype(np.uint8))
    (folder / "spikes.dat").write_bytes(rng.integers(0, 256, 2 * 16 * 8 // 8).astype(np.uint8).tobytes())
    savemat(folder / "two.mat", {"a": np.ones((4, 4, 3), np.uint8), "b": np.zeros((4, 4, 3), np.uint8)})
    (folder / "stretched").mkdir()
    for t in range(2):
        Image.fromarray(rng.choice([0, 85, 170, 255], (16, 24)).astype(np.uint8)).save(folder / f"stretched/{t}.png")
    (folder / "still.py").write_text(
        "from small_scenes import plate\n\n\ndef scene(seed=0, *, speed=1.0):\n    return plate(None)\n"
    )
    (folder / "bad.toml").write_text("[defects]\nprnu = 0.5\n")
    spad = '[sensor]\nmodel = "CountingSPAD"\nbits = 3\npde = 0.5\ndark_count_rate = 100.0\ndead_time = 2e-5\n'
    (folder / "my.toml").write_text(spad)
    (folder / "counter.toml").write_text(spad)
    head = "[recipe]\nname='t'\nframes=2\nheight=16\nwidth=16\npsnr=20.0\n"
    (folder / "t.toml").write_text(f"{head}[[scenes]]\nfamily='fan'\ncount=2\n")
    (folder / "fails.py").write_text(
        "import os\nfrom small_scenes import plate\n\n\n"
        "def scene(seed=0, *, speed=1.0):\n    assert os.path.isdir('ready')\n    return plate(None)\n"
    )
    (folder / "broken.toml").write_text(f"{head}[[scenes]]\nfamily='fails.py'\n")
    np.save(folder / "planes.npy", (rng.random((400, 6, 8)) < 0.01).astype(np.uint8))
    np.save(folder / "lit.npy", (rng.random((400, 6, 8)) < 0.4).astype(np.uint8))
    np.save(folder / "sums.npy", rng.binomial(50, 0.02, (100, 6, 8)).astype(np.uint8))
    np.save(folder / "counts.npy", rng.poisson(5.0, (100, 6, 8)).astype(np.uint8))
    for n, mean in enumerate((0.02, 0.5, 1.5, 3.0)):
        electrons = rng.poisson(mean, (400, 12, 16)) + rng.normal(0, 0.2, (400, 12, 16))
        np.save(folder / f"q{n}.npy", np.clip(np.round(electrons), 0, 7).astype(np.uint8))
    return folder


def test_every_option_has_a_row():
    """Read from the parsers: an option without a row fails here, and so does a row without an option."""
    assert set(ROWS) == set(options(qsim.cli.program.PROGRAM))


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row, id=f"{' '.join(key)}-{i}", marks=[pytest.mark.slow] if row.slow else [])
        for key, rows in ROWS.items()
        for i, row in enumerate(rows)
    ],
)
def test_the_option_acts_or_is_refused(row, work, tmp_path, capsys, monkeypatch):
    check(row, main, work, tmp_path, capsys, monkeypatch)


def ignores(argv: list[str]) -> int:
    """A program that takes --loud, does nothing with it, and does not refuse --odd."""
    Path("made.json").write_text(str("--loud" in argv))
    return 0


def test_the_check_finds_an_option_that_is_ignored(work, tmp_path, capsys, monkeypatch):
    """Another description is not an effect, and an accepted option is not refused."""
    with pytest.raises(AssertionError, match="changes nothing"):
        check(Acts("", "--loud"), ignores, work, tmp_path / "a", capsys, monkeypatch)
    with pytest.raises(AssertionError, match="accepted"):
        check(Refused("", "--odd", "odd"), ignores, work, tmp_path / "b", capsys, monkeypatch)
