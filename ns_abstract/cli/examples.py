"""Examples of every command, as ``--help`` and the documentation show them; tests parse each of them."""

from __future__ import annotations

_RUN = "--load-config RUN/config.yml"
_PATH = f"{_RUN} --camera-path-filename path.json"
_SET = "--translation 0.01 0 0 --rotation 0.5 0 0 --angle-units degrees"

#: By command: what each does, and its options.
EXAMPLES: dict[str, tuple[tuple[str, str], ...]] = {
    "ns-abstract-render": (
        ("What do cameras, units and set mean? Nothing is computed.", f"{_PATH} {_SET} --describe"),
        ("Bound one frame, small and coarse.", f"{_PATH} {_SET} --output-dir abstract --frames 0 --downscale-factor 8"),
        (
            "Bound all frames for an hour; go on with what an earlier run has found.",
            f"{_PATH} --perturbation-filename spec.json --output-dir abstract --time-budget 3600 --resume",
        ),
    ),
    "ns-abstract-certify": (
        (
            "Certify a classifier around every keyframe.",
            f"{_PATH} {_SET} --model net.onnx --property prop.json --output-dir certificate",
        ),
        (
            "Go on for an hour with eight processes.",
            f"{_PATH} {_SET} --model net.onnx --property prop.json --output-dir certificate --time-budget 3600 "
            "--workers 8 --resume",
        ),
        ("Print a network's layers, and what a cell of it takes.", "--model net.onnx --explain"),
    ),
    "ns-abstract-reach": (
        ("Prove that no run of a loop goes wrong.", f"{_RUN} --loop LOOP.json --output-dir loop"),
        (
            "Look for the largest error of the scene for which it still holds.",
            f"{_RUN} --loop LOOP.json --output-dir loop --time-budget 3600 --scene-margin",
        ),
        ("Go on, and film the tube of a certified cell.", f"{_RUN} --loop LOOP.json --output-dir loop --film --resume"),
    ),
    "ns-abstract-locate": (
        (
            "Where can a photograph have been taken?",
            f"{_RUN} --image photo.png --camera-path-filename path.json {_SET} --output-dir place",
        ),
        (
            "With noisier pixels, and a twentieth of them anything.",
            f"{_RUN} --image photo.png --camera-path-filename path.json {_SET} --output-dir place --noise 0.05 "
            "--outliers 0.05",
        ),
        (
            "Go on with what an earlier run has found.",
            f"{_RUN} --image photo.png --camera-path-filename path.json {_SET} --output-dir place --resume",
        ),
    ),
    "ns-abstract-compare": (
        (
            "How far do the pictures of two runs differ?",
            f"{_RUN} --other OTHER/config.yml --camera-path-filename path.json {_SET} --output-dir change",
        ),
        (
            "Prove that they differ by at most 0.03.",
            f"{_RUN} --other OTHER/config.yml --camera-path-filename path.json {_SET} --output-dir change "
            "--tolerance 0.03",
        ),
        (
            "Go on with what an earlier run has found.",
            f"{_RUN} --other OTHER/config.yml --camera-path-filename path.json {_SET} --output-dir change --resume",
        ),
    ),
    "ns-abstract-check": (
        ("Draw 200 claims of a result and prove them again.", "abstract"),
        ("Draw 1,000 in an hour.", "certificate --claims 1000 --seconds 3600"),
        ("The run has been moved since.", "abstract --load-config ELSEWHERE/config.yml"),
    ),
    "ns-abstract-demo": (
        ("Write all scenes.", "--output-dir demo"),
        ("Leave out the NeRF.", "--output-dir demo --splats-only"),
        ("Write them into the home folder.", "--output-dir ~/ns-abstract-demo"),
    ),
    "ns-abstract-viewer": (
        ("View a run with its bounds.", _RUN),
        ("Bound depths, too.", f"{_RUN} --depth True"),
        ("Listen on another port.", f"{_RUN} --viewer.websocket-port 7008"),
    ),
    "ns-abstract-export": (
        ("A video of all frames.", "mp4 --input-dir abstract --output-filename abstract.mp4"),
        ("The Gaussians of a run as a .ply.", f"ply {_RUN} --output-filename scene.ply"),
        (
            "A property as VNN-LIB, for other verifiers.",
            f"vnnlib {_PATH} {_SET} --model net.onnx --property prop.json --output-dir vnnlib",
        ),
    ),
    "ns-abstract-bench": (
        ("What does a cell cost on this machine?", "cell"),
        ("Error against run time for a scene of your own.", f"tightness {_RUN} --sets x yaw --seconds 60"),
        ("Attack bounds with thousands of renders.", f"soundness {_RUN} --poses 1000"),
    ),
}
