"""Files of measured presses with faults."""

from attacks.faults import mutated
from isocharge.serve import read_presses

NAMES = ("A", "B", "C")


def test_csv_with_faults(tmp_path, attack):
    path = tmp_path / "p.csv"
    good = b'# rig 7\nx_mm,y_mm,force_N,A,B,C,note\n1,2,0.5,10,20,30,"a\n# b"\n,,1,,2e1,30,\n'

    def read(data):
        path.write_bytes(data)
        assert len(read_presses(path, NAMES)) > 0

    read(good)
    attack("presses csv", read, lambda rng: mutated(rng, good), 10_000)
