"""Tests the sweep over speed and light, and the depths that the law predicts."""

import json

from qsim.cli.program import main


def test_sweep_over_speed_and_light(clip, tmp_path, capsys):
    """The depths of the law from the slowest clip lose less than 0.3 dB.

    Not where binary planes saturate: there motion helps them, and the law takes light as constant within a frame.
    """
    out = tmp_path / "sweep"
    words = ["tradeoff", str(clip.path), "--bits", "1,2,3", "--speed", "1,4", "--ppp", "0.3:30:2", "-o", str(out)]
    assert main([*words, "--instants", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    cells = found["cells"]
    agreement = found["agreement"]
    assert len(cells) == agreement["cells"] == 2 * 2 * 2
    sigmas = [row["sigmas"] for study in found["studies"] for row in study["rows"]]
    assert len(sigmas) == agreement["simulated"] == 2 * 2 * 6
    assert agreement["largest_sigmas"] == max(map(abs, sigmas))
    assert agreement["largest_loss_db"] == max(cell["loss_of_prediction_db"] for cell in cells)
    others = [cell for cell in cells if cell["best_bits"] != cell["best_bits_predicted"]]
    assert agreement["cells_with_another_depth"] == len(others)
    assert (out / "best.png").exists()
    lawful = [cell for cell in cells if cell["model"] == "multibit" or cell["ppp"] < 1]
    assert max(cell["loss_of_prediction_db"] for cell in lawful) < 0.3
    best = {(cell["speed"], cell["ppp"]): cell["best_bits"] for cell in cells if cell["model"] == "multibit"}
    assert best[4.0, 30.0] < best[1.0, 0.3]  # fast and bright needs short frames
