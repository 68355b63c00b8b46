"""Sensor files of three models, to which a test adds the table of defects."""

from __future__ import annotations

from pathlib import Path

FILES = {  # model -> [sensor] of a file
    "SPAD": 'model = "BinarySPAD"\npde = 0.4\ndark_count_rate = 200.0\n',
    "QIS": 'model = "QIS"\nquantum_efficiency = 0.8\ndark_current = 100.0\nread_noise = 0.2\n',
    "COUNTER": 'model = "CountingSPAD"\npde = 0.5\ndark_count_rate = 50.0\ndead_time = 1e-5\n',
}
SPAD, QIS, COUNTER = (f"[sensor]\n{text}bits = {{bits}}\n[defects]\n" for text in FILES.values())


def sensor_file(folder: Path, text: str, bits: int = 1, name: str = "mine.toml") -> str:
    (folder / name).write_text(text.format(bits=bits))
    return str(folder / name)
