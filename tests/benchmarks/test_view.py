"""The benchmark of ``persist view`` runs."""

from tests.benchmarks.bench_view import main


def test_the_blocks_of_a_larger_map_are_wider_and_not_more(capsys):
    main(["--cells", "1000,20000", "--most", "2000"])
    small, large = (line.split("│") for line in capsys.readouterr().out.splitlines() if "│ " in line and " to " in line)
    assert small[4].strip() == "1,000"
    assert int(large[4].replace(",", "")) <= 2000
    assert float(large[5].split(" to ")[1]) > float(small[5].split(" to ")[1])
