"""Files from outside, damaged at random: whoever reads them gives a value or one line, and never anything else."""

from __future__ import annotations

import shutil

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hostile_files import READERS, read_or_say

EXAMPLES = 60

# What is done to a file: (where, as a share of its length; what; how much).
Damage = tuple[float, str, bytes]
damages = st.lists(
    st.tuples(
        st.floats(0.0, 1.0),
        st.sampled_from(["overwrite", "insert", "delete", "cut", "repeat"]),
        st.one_of(
            st.binary(min_size=1, max_size=12),
            st.sampled_from(
                [b"nan", b"inf", b"-1", b"1e999", b"0", b"{", b"]", b":", b"\n", b"../", b"\x00", b"9" * 30]
            ),
        ),
    ),
    min_size=1,
    max_size=4,
)


def damaged(content: bytes, damage: list[Damage]) -> bytes:
    for share, what, words in damage:
        at = int(share * len(content))
        match what:
            case "overwrite":
                content = content[:at] + words + content[at + len(words) :]
            case "insert":
                content = content[:at] + words + content[at:]
            case "delete":
                content = content[:at] + content[at + len(words) :]
            case "cut":
                content = content[:at]
            case "repeat":
                content = content[:at] + content[at : at + 200] * 3 + content[at:]
    return content


@pytest.mark.parametrize("kind", READERS)
def test_damage_is_a_value_or_one_line(kind: str, tmp_path_factory: pytest.TempPathFactory):
    make, read = READERS[kind]
    folder = tmp_path_factory.mktemp("hostile")
    path = make(folder)
    whole = path.read_bytes()
    before = sorted(file for file in folder.rglob("*"))

    @settings(max_examples=EXAMPLES, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
    @given(damages)
    def try_it(damage: list[Damage]) -> None:
        path.write_bytes(damaged(whole, damage))
        read_or_say(kind, path)

    read(path)  # as it was
    shutil.rmtree(folder / "out", ignore_errors=True)
    try_it()
    assert sorted(file for file in folder.rglob("*")) == before  # nothing was written but where it was asked for
