import torch

from tests.benchmarks.bench_writing import house_rows, main


def test_writing_is_measured_along_known_unseen_and_partly_known_ways(voxel, walks, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    main(["--checkpoint", str(voxel), "--data", str(walks), "--memories", "voxel", "--houses", "1", "--steps", "1"])
    printed = capsys.readouterr().out
    assert all(f"{way} way" in printed for way in ("voxel, known", "unseen", "partly known"))
    assert printed.count("mean") == 3


def test_a_row_has_the_gain_of_writing_and_the_last_row_has_the_means():
    rows = house_rows(["a", "b"], [torch.tensor([10.0, 20.0]), torch.tensor([12.0, 19.0])])
    assert rows == [
        ("a", "10.00", "12.00", "+2.00"),
        ("b", "20.00", "19.00", "-1.00"),
        ("mean", "15.00", "15.50", "+0.50"),
    ]
