"""What people do wrong, and what they are told: one line that names the cure, exit code 2, nothing half-written.

Every row is a command line and words of its answer. Commands run in this process, in one folder that no mistake may
change; what a machine may lack (GPU, new LLVM, disk, package, Python) has separate tests below.
"""

from __future__ import annotations

import builtins
import errno
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import fakes
import numpy as np
import pytest
from clips import write_clip

import qsim.cli.program
import quiver.cli.program
from qsim import backend, files, llvm
from qsim.dataset import generation, recipe

ROOT = Path(__file__).parents[2]

MISTAKES = [
    # Names of commands, options, choices
    ("qsim rendr fan", "unknown command 'rendr' (did you mean 'render'?)"),
    ("qsim --jsn check lit", "unknown option --jsn"),
    ("qsim render fan", "-o/--output is required (optional only with --explain)"),
    ("qsim render fan --ouput x", "unknown option --ouput (did you mean '--output'?)"),
    ("qsim render fan -o x --fps 2000", "unknown option --fps (did you mean '--frame-rate'?)"),
    ("qsim generate good.toml --jobs 3", "unknown option --jobs (did you mean '--workers'?)"),
    ("qsim sense lit --photons 3", "unknown option --photons (did you mean '--ppp'?)"),
    ("qsim sense lit -b 3", "unknown option -b"),
    ("qsim doctor sensors", "unexpected argument sensors"),
    ("qsim validate lens", "WHAT: expected one of sensor, render, light, engines, reading, got 'lens' (did you mean "),
    ("qsim completion tcsh", "SHELL: expected one of bash, zsh, fish, got 'tcsh'"),
    ("quiver trian data -o x", "unknown command 'trian' (did you mean 'train'?)"),
    ("quiver train data -o x --lr 1e-3", "unknown option --lr (did you mean '--learning-rate'?)"),
    ("quiver train data -o x --epochs 9", "unknown option --epochs (did you mean '--steps'?)"),
    ("quiver train data -o x --preset mergnet", "'mergnet' (did you mean 'mergenet'?)"),
    ("quiver restore lit -o x.npy --mode fast", "--mode: expected one of exact, streaming, windows, got 'fast'"),
    # An empty path, as of a variable of the shell that is not set
    ("qsim render '' -o x", "argument SCENE: got an empty text; is a variable of the shell not set?"),
    ("qsim render fan -o ''", "argument --output: got an empty text"),
    ("qsim sense lit '' --ppp 3", "argument PATH: got an empty text"),
    ("qsim generate ''", "argument RECIPE: got an empty text"),
    ("qsim check lit ''", "argument PATH: got an empty text"),
    ("qsim preview ''", "argument PATH: got an empty text"),
    ("qsim report lit '' -o x.html", "argument PATH: got an empty text"),
    ("qsim convert '' x --frame-rate 9", "argument INPUT: got an empty text"),
    ("qsim convert light.npy '' --frame-rate 9", "argument OUTPUT: got an empty text"),
    ("qsim calibrate --bits 3 --dark '' 1e-3 -o x.toml", "argument --dark: got an empty text"),
    ("qsim tradeoff ''", "argument SOURCE: got an empty text"),
    ("qsim demo ''", "argument FOLDER: got an empty text"),
    ("quiver restore '' -o x.npy", "argument SOURCE: got an empty text"),
    ("quiver train '' -o x", "argument DATA: got an empty text"),
    ("quiver evaluate data --output=", "argument --output: got an empty text"),
    ("quiver domain mergenet ''", "argument CLIPS: got an empty text"),
    # Scenes
    ("qsim render fann -o x", "no scene family 'fann' (did you mean 'fan'?)"),
    ("qsim render none.py -o x", "scene none.py: no such file"),
    ("qsim render broken.py -o x", "broken.py:1: not valid Python"),
    ("qsim render noscene.py -o x", "noscene.py: a scene file needs a function scene(seed=0, *, speed=1.0)"),
    ("qsim render three.py -o x", "scene() returned a int; it must return a qsim.scene.Scene"),
    ("qsim render none.glb -o x", "mesh none.glb: no such file"),
    ("qsim render short.glb -o x", "short.glb: 4 bytes are no .glb file; it is truncated"),
    ("qsim render rest.gltf -o x", "rest.gltf: has no animation; use shapes.mesh_file for a mesh that keeps its shape"),
    ("qsim generate body.toml -o x", "short.glb: 4 bytes are no .glb file; it is truncated"),
    ("qsim render fan -o lit", "lit: exists; name another, or replace it with --force"),
    ("qsim validate render --scenes fann", "did you mean 'fan'?"),
    ("qsim render good.toml -o x", "good.toml: is a recipe of a data set, not a scene; use `qsim generate good.toml`"),
    ("qsim plan fan", "fan: is a scene family, not a recipe; use `qsim render fan`"),
    # Sizes and numbers
    ("qsim render fan -o x --height 0", "--height: expected a whole number from 1 to 100000, got '0'"),
    ("qsim render fan -o x --frames -3", "--frames: expected a whole number from 1 to 100000, got '-3'"),
    ("qsim render fan -o x --width 12.5", "--width: expected a whole number from 1 to 100000, got '12.5'"),
    ("qsim render fan -o x --seed -1", "--seed: expected a whole number from 0 to 2147483647, got '-1'"),
    ("quiver evaluate data -o x --seed -1", "--seed: expected a whole number from 0 to 2147483647, got '-1'"),
    ("quiver restore lit -o x.npy --ppp 3 --seed 2147483648", "--seed: expected a whole number from 0 to 2147483647,"),
    ("quiver train data -o x --seed -1", "--seed: expected a whole number from 0 to 2147483647, got '-1'"),
    ("quiver ablate data -o x --seed 0.5", "--seed: expected a whole number from 0 to 2147483647, got '0.5'"),
    ("quiver domain mergenet lit --seed -1", "--seed: expected a whole number from 0 to 2147483647, got '-1'"),
    ("qsim render fan -o x --speed nan", "--speed: expected a number from 0.001 to 1000, got 'nan'"),
    ("qsim render fan -o x --speed 1e300", "--speed: expected a number from 0.001 to 1000, got '1e300'"),
    ("qsim tradeoff fan -o x --speed 1e300", "speed: expected a number from 0.001 to 1000, got 1e+300"),
    ("qsim render fan -o x --bands cmyk", "--bands: expected one of rgb, got 'cmyk'"),
    ("qsim render fan -o x --camera-path none.json", "none.json: no such file"),
    ("qsim render fan -o x --camera-path text.txt", "text.txt: not readable as JSON"),
    ("qsim convert video x --to nerfstudio", "video: has no camera (imported video); only rendered clips have poses"),
    ("qsim sense lit --ppp 3 --colour rggb", "has one band, and the sensor has colour filters; render it with"),
    ("qsim sense lit --ppp 3 --colour rgbb", "unknown colour filter array 'rgbb' (did you mean 'rggb'?)"),
    ("qsim preview lit --frame 99", "--frame 99: lit has frames 0..2"),
    ("qsim plan good.toml --machines 0", "--machines: expected a whole number from 1, got '0'"),
    ("qsim tradeoff --table --size 240", "expected ROWSxCOLUMNS, as in 240x320, got '240'"),
    ("qsim tradeoff --table --bits 1,x", "--bits: expected a whole number from 1 to 16, got 'x'"),
    ("quiver bench --size 64", "expected ROWSxCOLUMNS, as in 240x320, got '64'"),
    ("quiver train data -o x --preset rvtr", "'rvtr' (did you mean 'rvrt'?)"),
    ("quiver train data -o x --preset emvd --protocol paper", "--protocol paper: emvd has quick and published; choose"),
    ("quiver train data -o x --preset rvrt --steps 1 --frames 4", "--frames must be at least 12, the window of rvrt"),
    ("quiver train data -o x --preset emvd --steps 1 --loss l1", "--loss l1: emvd is trained with own; leave --loss"),
    ("quiver train none.npy -o x --preset bit2bit --steps 1", "none.npy: no stored stream, which is a .npy with its"),
    ("quiver train lit -o x --preset bit2bit --steps 1 --ppp 3", "--ppp: is for data sets, and bit2bit learns from"),
    ("quiver train data -o x --steps 0", "--steps: expected a whole number from 1, got '0'"),
    ("quiver restore lit -o x.npy --memory lots", "expected a size such as 2GB or 500MB, got 'lots'"),
    # Units
    ("qsim render fan -o x --frame-rate 0.0005", "--frame-rate: expected a number from 1 to 1e+08, got '0.0005'"),
    ("qsim render fan -o x --shutter 50", "--shutter: expected a number from 0 to 1, got '50'"),
    ("qsim render fan -o x --psnr 500", "--psnr: expected a number from 10 to 80, got '500'"),
    ("qsim convert light.npy x --frame-rate 2000 --exposure 500", "exposure 500.0 s: expected more than 0 and at most"),
    ("qsim calibrate --bits 3 --dark codes.npy 1ms -o x.toml", "'1ms' is not a number; give seconds, as in 1e-3"),
    ("qsim sense lit --ppp 3 --sensor percent.toml", "quantum_efficiency is a number, above 0 and at most 1; got 80"),
    # Light
    ("qsim sense lit --ppp 0", "--ppp: expected a number from 1e-06 to 1e+06, got '0'"),
    ("qsim sense lit --ppp nan", "--ppp: expected a number from 1e-06 to 1e+06, got 'nan'"),
    ("qsim sense lit --ppp=-3", "--ppp: expected a number from 1e-06 to 1e+06, got '-3'"),
    ("qsim sense lit --ppp 3 --lux 3", "give the light level as ppp or as lux, not both"),
    ("qsim sense lit --ppp 1e300", "--ppp: expected a number from 1e-06 to 1e+06, got '1e300'"),
    ("qsim sense video", "its radiance is relative (imported video) and has no absolute light; give a target"),
    ("qsim sense video --lux 3", "which lux need; give --pixel-pitch, as in --pixel-pitch 1.1e-06, where 1 lx"),
    ("qsim sense black --ppp 3", "black: mean of photons is 0, no factor reaches 3 PPP; is the light on?"),
    # Sensors and streams
    ("qsim sense lit --ppp 3 --exposures 1,0", "--exposures: expected a number from 1e-06 to 1, got '0'"),
    (
        "qsim sense lit --ppp 3 --exposures 1,1.5",
        "--exposures: expected a number from 1e-06 to 1, got '1.5'",
    ),
    ("qsim sense lit --ppp 3 --row-delay 0", "--row-delay: expected a number above 0, got '0'"),
    ("qsim sense lit --ppp 3 --row-delay 1e-3", "longer than a frame or plane of 0.0005 s; the largest delay is"),
    ("qsim sense lit --ppp 3 --row-order up", "row_order up: orders rows that have their own time; give row_delay"),
    (
        "qsim sense lit --ppp 3 --row-delay 1e-6 --row-order upp",
        "--row-order: expected one of down, up, right, left, got 'upp' (did you mean 'up'?)",
    ),
    ("qsim sense lit --ppp 3 --bits 0", "--bits: expected a whole number from 1 to 16, got '0'"),
    ("qsim sense lit --ppp 3 --bits 17", "--bits: expected a whole number from 1 to 16, got '17'"),
    ("qsim sense lit --ppp 3 --sensor quiver-fysical", "did you mean 'quiver-physical'?"),
    (
        "qsim sense lit --ppp 3 --sensor key.sensor.toml",
        "unknown key 'quantum_efficency' (did you mean 'quantum_efficiency'",
    ),
    ("qsim sense lit --ppp 3 --sensor noise.sensor.toml", "QIS.read_noise is a number, at least 0; got -0.2"),
    ("qsim sense lit --ppp 3 --name a/b", "name: expected a"),
    ("qsim sense lit --ppp 3 --group", "--group sums planes, and needs the bits of a code, as in --bits 3"),
    ("qsim sense none --ppp 3", "none: no such clip"),
    ("qsim sense . --ppp 3", ".: not a clip folder (it has no clip.json)"),
    ("qsim sense lit --ppp 3 --sensor none.toml", "none.toml: no such sensor file"),
    ("qsim sense lit --ppp 3 --defects none.toml", "none.toml: no such file of defects"),
    ("qsim sense lit --ppp 3 --defects percent.toml", "percent.toml: has no table [defects]"),
    ("qsim sense data/clips/fan_0000 --replay 0", "choose one of its streams with --name: quiver-physical_1bit"),
    ("qsim sense text.txt --ppp 3", "text.txt: not a clip folder (it has no clip.json)"),
    ("qsim sense data --replay fan_0000", "--replay fan_0000: expected CLIP:FRAME, as in fan_0003:7"),
    ("qsim sense lit --ppp 3 --sensor spad512s --slices 2", "slices of an exposure are for a CountingSPAD or a QIS"),
    (
        "qsim sense lit --ppp 3 --sensor spike.sensor.toml",
        "SpikeCamera.threshold is a whole number of electrons, 1 ...",
    ),
    ("qsim sense lit --ppp 3 --sensor iso.sensor.toml", "iso needs a full_well above 0 and codes above the offset"),
    ("qsim convert lit x.dat", "lit: a spike file holds one bit per pixel, this is light; name a stream of one bit"),
    ("qsim sense lit --ppp 3 --follow", "--follow is for the photons of a CountingSPAD, this is a QIS"),
    ("qsim convert lit x.npz", "lit: a clip has light, and no single photons; name one of its streams"),
    ("qsim compare lit --span 1", "has no streams to compare; make some with `qsim sense`"),
    # What is in the way
    ("qsim render fan -o text.txt --force", "text.txt: exists and is not a clip, which is all that is replaced"),
    ("qsim render fan -o data --force", "data: exists and is not a clip, which is all that is replaced"),
    (
        "qsim convert light.npy data --force --frame-rate 2000 --exposure 1e-4 --transfer linear",
        "data: exists and is no",
    ),
    ("quiver restore lit -o x --ppp 3", "x: restored video is written as .npy; name a .npy file"),
    ("qsim render lit -o x", "lit: is a clip, made from a scene already"),
    ("qsim render raises.py -o x", "raises.py:2: ZeroDivisionError: division by zero"),
    ("quiver restore text.txt -o x.npy", "text.txt: not a stream, clip folder or .npy array"),
    ("qsim demo lit", "lit: is a clip, which holds nothing else; name another folder"),
    ("qsim demo data", "data: is a data set, which holds nothing else; name another folder"),
    ("qsim demo data/clips/fan_0000/streams", "streams: is part of a clip, which holds nothing else"),
    ("qsim demo light.npy", "light.npy: exists and was not made by `qsim demo`; name another folder"),
    ("qsim tradeoff fan -o lit", "lit: is a clip, which holds nothing else; name another folder"),
    ("qsim convert data lit --to mp4", "lit: is a clip, which holds nothing else; name another folder"),
    ("qsim convert pictures lit --frame-rate 9 --transfer srgb", "lit: is a clip, which holds nothing else"),
    (
        "qsim convert data/clips/fan_0000/streams/quiver-physical_1bit_3.25ppp.json data/clips/fan_0000/streams/x.npy",
        "fan_0000, which holds nothing else; name another place",
    ),
    ("qsim preview lit -o lit/streams/x.png", "lit, which holds nothing else; name another place"),
    (
        "qsim convert both x --frame-rate 9 --transfer srgb",
        "both: holds videos (both/a.mp4) and other recordings (both/0.png); choose with --layout",
    ),
    ("quiver bench -o lit", "lit: is a clip, which holds nothing else; name another folder"),
    ("quiver bench -o data", "data: is a data set, which holds nothing else; name another folder"),
    ("quiver ablate data -o lit", "lit: is a clip, which holds nothing else; name another folder"),
    ("quiver evaluate empty -o lit --protocol x4k1000fps", "lit: is a clip, which holds nothing else"),
    # Recipes
    ("qsim generate none.toml", "none.toml: no such recipe"),
    ("qsim generate bad.toml -o x", "bad.toml:1: not valid TOML"),
    ("qsim generate key.toml -o x", "key.toml: unknown key 'recipe.frmaes' (did you mean 'frames'?)"),
    ("qsim generate type.toml -o x", "type.toml: recipe.frames: expected a whole number from 1 to 100000, got '3'"),
    ("qsim generate zero.toml -o x", "zero.toml: recipe.frames: expected a whole number from 1 to 100000, got 0"),
    ("qsim generate rate.toml -o x", "recipe.frame_rate: expected a number from 1 to 1e+08, got 0.0005"),
    ("qsim generate family.toml -o x", "family.toml: scenes[0]: unknown family 'fann' (did you mean 'fan'?)"),
    ("qsim generate split.toml -o x", "split: expected one of train, val, test, got 'tset'"),
    ("qsim generate leak.toml -o x", "the test split holds families that training never sees: move its scenes"),
    (
        "qsim generate dark.toml -o x",
        "streams[0].ppp: expected a number from 1e-06 to 1e+06, or a list of them, got -1",
    ),
    ("qsim generate more.toml -o data", "was made from another recipe, without the clip fan_0002; use another folder"),
    ("qsim generate good.toml -o lit", "lit: is not empty and not a data set; use another folder"),
    ("qsim generate good.toml --shard 5/3", "expected I/N with 1 <= I <= N, as in 7/100, got '5/3'"),
    ("qsim generate good.toml --workers -1", "--workers: expected a whole number from 0 to 100000, got '-1'"),
    # Foreign files
    ("qsim convert light.npy x", "files do not state the capture rate; add --frame-rate, as in 2000"),
    ("qsim convert light.npy x --frame-rate 0", "--frame-rate: expected a number above 0, got '0'"),
    ("qsim convert light.npy x --frame-rate 9 --exposure 0", "--exposure: expected a number above 0, got '0'"),
    ("qsim convert light.npy x --frame-rate 9 --columns 0", "--columns: expected a whole number from 1, got '0'"),
    (
        "qsim convert codes.npy x --frame-rate 9 --layout codes --bits 0",
        "--bits: expected a whole number from 1 to 16, got '0'",
    ),
    ("qsim tradeoff fan -o x --frames 0", "--frames: expected a whole number from 1 to 100000, got '0'"),
    ("qsim convert text.txt x --frame-rate 9 --layout visionsim", "text.txt: has no transforms.json; a recording of"),
    ("qsim convert empty x --frame-rate 9 --layout visionsim", "empty: has no transforms.json; a recording of"),
    ("qsim convert none.npy x --frame-rate 9", "none.npy: no such file"),
    ("qsim convert nan.npy x --frame-rate 9", "nan.npy: value nan at (t, y, x) = (0, 0, 0) is not a light level"),
    ("qsim convert negative.npy x --frame-rate 9", "is not a light level: expected finite and >= 0"),
    ("qsim convert empty.npy x --frame-rate 9", "empty.npy: has no frames"),
    ("qsim convert flat.npy x --frame-rate 9", "flat.npy: expected frames [T, H, W], found an array of shape [8, 10]"),
    ("qsim convert norows.npy x --frame-rate 9", "norows.npy: frames of 0 x 10 pixels"),
    ("qsim convert objects.npy x --frame-rate 9", "objects.npy: an array of object; numbers are expected"),
    ("qsim convert text.txt x --frame-rate 9", "text.txt: unknown kind of file; name its --layout: cube"),
    ("qsim convert broken.png x --frame-rate 9 --transfer srgb", "broken.png: not readable as PNG"),
    ("qsim convert grey.png x --frame-rate 9", "a picture does not state its transfer curve; add --transfer 'linear'"),
    ("qsim convert odd.bin x --frame-rate 9 --layout swissspad2-half", "1001 bytes are not a whole number of"),
    (
        "qsim convert codes.npy x --frame-rate 9 --layout codes --bits 2",
        "is not a 2-bit code (0..3); give the right --bits",
    ),
    ("qsim convert light.npy x --frame-rate 9 --columns 99", "--columns 99: the frames have 10 columns"),
    (
        "qsim convert lit x.webm",
        "x.webm: name the kind of output with --to: challenge, cube, events, exr, mp4, nerfstudio, pairs,",
    ),
    ("qsim convert lit x/y --to challenge", "lit: has no stream called red; the challenge has the streams red, green"),
    ("quiver restore lit -o x.zip", "lit: holds no cubes of the challenge; they are called SCENE/000000.npy"),
    ("quiver restore lit -o x.zip --ppp 3", "--ppp: x.zip is a submission, whose layout states it; leave it out"),
    # Looking and studying
    (
        "qsim report empty -o x.html",
        "nothing to report; expected a clip, a data set, a restored video or an evaluation",
    ),
    ("qsim report empty -o text.txt/sub/x.html", "text.txt: is a file where a folder is needed; name another with -o"),
    ("qsim render fan -o text.txt/x", "text.txt: is a file where a folder is needed; name another with -o"),
    ("qsim convert lit text.txt/x.npy", "text.txt: is a file where a folder is needed"),
    ("quiver restore lit -o lit/streams/x.npy --ppp 3", "lit, which holds nothing else; name another place"),
    ("quiver restore lit -o text.txt/x.npy --ppp 3 --method moment", "text.txt: is a file where a folder is needed"),
    ("qsim report lit -o x.pdf", "x.pdf: a page is a .html file, as in -o x.html"),
    ("qsim explore lit -o x.pdf", "x.pdf: a page is a .html file, as in -o x.html"),
    ("qsim explore data", "data: is a data set; name one of its clips, as in data/clips/NAME"),
    ("qsim explore text.txt", "text.txt"),
    ("qsim preview lit -o x.webm", "x.webm: a preview is a .mp4, .gif, .png file, as in -o x.mp4"),
    ("qsim preview data", "data: is a data set; name one of its clips, as in data/clips/NAME"),
    ("qsim preview codes.npy", "whole numbers are codes or packed planes; add --bits 3"),
    ("qsim tradeoff", "give a clip or a scene, --table, or --paper-figure"),
    ("qsim tradeoff lit", "lit: 2000 fps; this study needs a clip of at least 10000 fps, as in `qsim render`"),
    ("qsim tradeoff --paper-figure 3 -o x", "--paper-figure: expected one of 1, 2, got '3'"),
    ("qsim calibrate --bits 3 -o x.txt", "x.txt: the sensor file is a .toml, as in -o my_sensor.toml"),
    ("qsim calibrate --bits 3 --dark codes.npy -o x.toml", "give a file and its exposure in seconds, as in --dark"),
    ("qsim calibrate --bits 3 --dark text.txt 1 -o x.toml", "text.txt: unknown kind of file; name its --layout: cube"),
    ("qsim tradeoff --paper-figure 1 -o text.txt", "text.txt: is a file where a folder is needed"),
    (
        "qsim calibrate --bits 99 --dark codes.npy 1e-3 -o x.toml",
        "--bits: expected a whole number from 1 to 16, got '99'",
    ),
    ("qsim validate sensor -o x.txt", "x.txt: a figure is a .png, .svg or .pdf file"),
    ("qsim check lit text.txt", "text.txt: not a clip folder (it has no clip.json)"),
    # Restoring and comparing
    ("quiver restore none -o x.npy", "none: no such file or folder"),
    ("quiver restore data -o x.npy", "data: is a data set; name one of its clips, as in data/clips/fan_0000"),
    ("quiver restore empty -o x.npy", "empty: neither a clip nor a data set (it has no clip.json and no dataset.json)"),
    ("quiver domain moment", "moment: a classical method has no weights; name mergenet, a .safetensors file or"),
    ("quiver train data -o x --steps 1 --start qbp", "qbp: a classical method has no weights; name mergenet, a"),
    ("quiver restore lit -o x.mp4", "x.mp4: restored video is written as .npy"),
    ("quiver restore lit -o light.npy --ppp 3", "light.npy: exists; name another, or replace it with --force"),
    ("quiver restore lit -o x.npy --ppp 3 --method momment", "no method 'momment' (did you mean 'moment'?)"),
    ("quiver restore lit -o x.npy --ppp 3 --method moment:x", "the window after the colon is a number of frames"),
    ("quiver restore lit -o x.npy --ppp 3 --method none.safetensors", "none.safetensors: no such weights file"),
    ("quiver restore lit -o x.npy --method moment", "lit: choose one of its streams with --stream (none), or sense"),
    (
        "quiver restore data/clips/fan_0000 -o x.npy --stream quiver-physical_3bit_3.25ppp --bits 1",
        "--bits: data/clips/fan_0000/streams/quiver-physical_3bit_3.25ppp.npy is a stored stream, which has its own",
    ),
    (
        "quiver restore codes.npy -o x.npy --ppp 3 --width 80 --planes 2",
        "only a clocked SPAD sums planes, this is a QIS",
    ),
    ("quiver restore codes.npy -o x.npy --seed 1", "--seed: is for noise that is drawn, and codes.npy holds codes"),
    ("quiver restore lit -o x.npy --ppp 3 --width 8", "--width: describes a bare array, and lit is a clip; leave it"),
    (
        "quiver restore lit -o x.npy --ppp 3 --method moment --mode streaming",
        "--mode: acts on networks, and moment is classical; leave it out",
    ),
    ("quiver evaluate lit -o x --split val", "--split: chooses clips of a data set, and lit is one clip; leave it out"),
    ("quiver evaluate data -o x --frames 5", "--frames: belongs to --static COUNTS; leave it out"),
    ("quiver evaluate", "give a data set or clip folder and -o, or --static COUNTS"),
    ("quiver evaluate none -o x", "none: no such data set"),
    ("quiver evaluate lit -o x --protocol x4k1000fps", "lit: holds no videos and no folders of pictures; name the"),
    ("quiver evaluate none -o x --protocol x4k1000fps", "none: no such folder; name the folder of the test set"),
    ("quiver evaluate data -o x --protocol x4k1000fps --bits 3", "--bits: --protocol x4k1000fps decides it; leave it"),
    ("quiver evaluate data -o x --methods naive,,moment", "--methods: expected values with commas between them"),
    ("quiver evaluate data -o lit", "lit: is a clip, which holds nothing else; name another folder"),
    ("quiver evaluate --static light.npy", "light.npy: expected whole counts [N, H, W] or [T, K, H, W], got float32"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with good and bad things in it."""
    top = tmp_path_factory.mktemp("mistakes")
    write_clip(top / "lit", frames=3, height=8, width=10)
    write_clip(top / "video", frames=3, height=8, width=10, relative=True)
    write_clip(top / "black", frames=2, relative=True, radiance=np.zeros((2, 8, 10)))
    generation.generate(recipe.parse(fakes.RECIPE), top / "data", generation.Options(workers=0), make=fakes.make)
    (top / "empty").mkdir()
    arrays = {
        "light": np.ones((3, 8, 10), np.float32),
        "nan": np.full((3, 8, 10), np.nan, np.float32),
        "negative": -np.ones((3, 8, 10), np.float32),
        "empty": np.zeros((0, 8, 10), np.float32),
        "flat": np.zeros((8, 10), np.float32),
        "norows": np.zeros((3, 0, 10), np.float32),
        "codes": np.full((2, 8, 10), 5, np.uint8),
        "objects": np.array([{}], dtype=object),
    }
    for name, array in arrays.items():
        np.save(top / f"{name}.npy", array, allow_pickle=True)
    from PIL import Image

    Image.fromarray(np.zeros((8, 10), np.uint8)).save(top / "grey.png")
    for name in ("first", "second"):
        (top / "pictures" / name).mkdir(parents=True)
        shutil.copy(top / "grey.png", top / "pictures" / name / "0.png")
    (top / "both").mkdir()
    shutil.copy(top / "grey.png", top / "both" / "0.png")
    (top / "both" / "a.mp4").touch()
    sensor = '[sensor]\nmodel = "QIS"\nquantum_efficiency = 0.8\ndark_current = 1.6\nread_noise = 0.2\nbits = 3\n'
    texts = {
        "text.txt": "words\n",
        "raises.py": "def scene(seed=0, *, speed=1.0):\n    return 1 / 0\n",
        "broken.png": "\x89PNG\r\n",
        "odd.bin": "x" * 1001,
        "broken.py": "def scene(:\n",
        "short.glb": "glTF",
        "rest.gltf": '{"asset": {"version": "2.0"}}',
        "noscene.py": "x = 1\n",
        "three.py": "def scene(seed=0, *, speed=1.0):\n    return 3\n",
        "bad.toml": "[recipe\n",
        "good.toml": fakes.RECIPE,
        "percent.toml": sensor.replace("0.8", "80"),
        "key.sensor.toml": sensor.replace("efficiency", "efficency"),
        "noise.sensor.toml": sensor.replace("0.2", "-0.2"),
        "iso.sensor.toml": f"{sensor}iso = 100\n",
        "spike.sensor.toml": '[sensor]\nmodel = "SpikeCamera"\nquantum_efficiency = 0.6\ndark_current = 0.0\n'
        "threshold = 0\n",
    }
    changes = {
        "key": ("frames = 3", "frmaes = 3"),
        "type": ("frames = 3", 'frames = "3"'),
        "zero": ("frames = 3", "frames = 0"),
        "rate": ("2000.0", "0.0005"),
        "family": ('"fan"', '"fann"'),
        "body": ('"fan"', '"short.glb"'),
        "split": ('split = "test"', 'split = "tset"'),
        "leak": ('family = "fan"\nseeds = [0, 1]', 'family = "tumble"\nseeds = [1]'),
        "dark": ("ppp = 3.25", "ppp = -1"),
        "more": ("seeds = [0, 1]", "seeds = [0, 1, 2]"),
    }
    for name, (old, new) in changes.items():
        assert old in fakes.RECIPE
        texts[f"{name}.toml"] = fakes.RECIPE.replace(old, new, 1)
    for name, text in texts.items():
        (top / name).write_text(text, encoding="latin-1")
    return top


def tree(folder: Path) -> dict[str, tuple[int, int]]:
    """Every file with its size and time: what a mistake must leave as it was."""
    found = {}
    for path in folder.rglob("*"):
        status = path.stat()
        found[str(path)] = (status.st_size, status.st_mtime_ns) if path.is_file() else (0, 0)
    return found


def told(capsys: pytest.CaptureFixture[str], line: str) -> str:
    """The one line that a mistake in the present folder gets."""
    before = tree(Path.cwd())
    program, *words = shlex.split(line)
    code = {"qsim": qsim.cli.program.main, "quiver": quiver.cli.program.main}[program](words)
    out, err = capsys.readouterr()
    assert (code, out) == (2, ""), err
    assert err.count("\n") == 1, err
    assert err.startswith(program)
    assert "Traceback" not in err
    assert tree(Path.cwd()) == before
    return err


def test_there_are_enough_of_them():
    assert len(MISTAKES) >= 60
    assert len({line for line, _ in MISTAKES}) == len(MISTAKES)


@pytest.mark.parametrize(("line", "words"), MISTAKES, ids=[line for line, _ in MISTAKES])
def test_a_mistake_is_one_line_that_names_the_cure(folder, monkeypatch, capsys, line, words):
    monkeypatch.chdir(folder)
    assert words in told(capsys, line)


def test_the_table_would_notice_a_traceback(folder, monkeypatch, capsys):
    """A defect of ours is no mistake of the user: it is not hidden behind one line."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr("qsim.streams.clip.Clip.open", lambda path: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        told(capsys, "qsim check lit")


# What the machine lacks


@pytest.mark.parametrize(
    ("line", "target"),
    [
        ("qsim sense lit --ppp 3 -o mine", "lit/streams/mine.json"),
        ("qsim preview lit -o look.png", "look.png"),
        ("qsim report lit -o page.html", "page.html"),
        ("qsim explore lit -o explore.html", "explore.html"),
        ("qsim convert light.npy clip --frame-rate 9", "clip"),
        ("quiver restore data/clips/fan_0000 -o x.npy --method moment --stream quiver-physical_3bit_3.25ppp", "x.npy"),
    ],
)
def test_a_full_disk(folder, tmp_path, monkeypatch, capsys, line, target):
    """The disk is full when a file is to be made safe: the cure is named, and nothing that a reader accepts is left."""

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    shutil.copytree(folder, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    monkeypatch.setattr(files.os, "fsync", full)
    program, *words = line.split()
    assert {"qsim": qsim.cli.program.main, "quiver": quiver.cli.program.main}[program](words) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "No space left on device" in err
    assert "make space and run the same command again" in err
    assert not Path(target).exists()


@pytest.mark.parametrize(
    ("line", "work"),
    [
        ("qsim report lit -o empty/deep/x.html", "qsim.report.report.build_page"),
        ("qsim render fan -o empty/deep/x", "qsim.dataset.scene_rendering.choose_budget"),
    ],
)
def test_a_folder_that_is_not_ours(folder, monkeypatch, capsys, line, work):
    """A page or a clip that has no place to go is not made first."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(work, lambda *_, **__: 1 / 0)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "empty")
    said = told(capsys, line)
    assert "no permission to write into " in said
    assert "empty; name another" in said


def test_no_gpu(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("QSIM_ENGINE", "cuda")
    monkeypatch.setattr(backend, "decided", backend.decide)
    monkeypatch.setattr(
        backend, "probe_cuda", lambda: backend.Probe("cuda", None, False, "no NVIDIA driver on this machine")
    )
    err = told(capsys, "qsim doctor")
    assert "engine cuda does not work here (CUDA: no NVIDIA driver on this machine); it needs an NVIDIA GPU" in err


def test_no_gpu_for_a_network(folder, monkeypatch, capsys):
    torch = pytest.importorskip("torch")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    line = "quiver train data -o x --device cuda --steps 1"
    assert "--device cuda: torch finds no CUDA device here; use --device cpu" in told(capsys, line)


def test_an_old_llvm(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("QSIM_ENGINE", "llvm")
    monkeypatch.setattr(backend, "decided", backend.decide)
    monkeypatch.setattr(llvm, "usable", lambda: [llvm.Library("/usr/lib/libLLVM-14.so", "of the system")])
    monkeypatch.setattr(backend, "cached_probe", lambda *_: backend.Probe("llvm", None, False, "older than LLVM 16"))
    err = told(capsys, "qsim doctor")
    assert (
        "engine llvm does not work here (/usr/lib/libLLVM-14.so: older than LLVM 16); install LLVM 16 or newer" in err
    )


def test_an_engine_that_does_not_exist(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("QSIM_ENGINE", "metal")
    assert "engine 'metal': expected one of cuda, llvm, scalar" in told(capsys, "qsim doctor")


@pytest.mark.parametrize(
    ("package", "line"),
    [
        ("av", "qsim preview lit -o x.mp4"),
        ("zarr", "qsim convert lit x.zarr"),
        ("torch", "quiver restore lit -o x.npy --ppp 3.25 --method naive"),
    ],
)
def test_a_package_that_is_not_installed(folder, monkeypatch, capsys, package, line):
    real = builtins.__import__

    def without(name: str, *rest: object, **more: object) -> object:
        if name.split(".")[0] == package:
            raise ModuleNotFoundError(f"No module named {package!r}", name=package)
        return real(name, *rest, **more)

    monkeypatch.chdir(folder)
    monkeypatch.setattr(builtins, "__import__", without)
    assert f"needs the package {package}, which is not installed: pip install {package}" in told(capsys, line)


def test_too_little_memory(folder, monkeypatch, capsys):
    def hoard(path: object) -> None:
        raise MemoryError("Unable to allocate 7 TiB")

    monkeypatch.chdir(folder)
    monkeypatch.setattr("qsim.streams.clip.Clip.open", hoard)
    err = told(capsys, "qsim check lit")
    assert "not enough memory (Unable to allocate 7 TiB); try fewer or smaller frames" in err


@pytest.mark.skipif(shutil.which("make") is None, reason="no make here")
@pytest.mark.parametrize("version", ["(3, 9, 1)", "(3, 14, 0)"])
def test_a_wrong_python(tmp_path, version):
    """`make setup` with a Python that says it is another version: told before anything is installed."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    fake = tmp_path / "python"
    fake.write_text(
        f"#!/bin/sh\nexec {sys.executable} -c \"import sys; sys.version_info = {version}; sys.version = 'other'; $2\"\n"
    )
    fake.chmod(0o755)
    done = subprocess.run(
        ["make", "setup", f"PYTHON={fake}"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "qsim needs Python 3.11, 3.12 or 3.13, and" in done.stderr
    assert "name another with PYTHON=python3.12" in done.stderr
    assert not (tmp_path / ".venv").exists()


def test_the_reader_of_our_output_is_gone(folder):
    """`qsim doctor --devices | head -1` is no error."""
    line = f"{sys.executable} -m qsim doctor --devices | head -1"
    done = subprocess.run(line, shell=True, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stderr == ""
