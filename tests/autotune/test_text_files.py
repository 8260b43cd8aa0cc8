from __future__ import annotations

from pathlib import Path

import pytest

from autotune.errors import InputError
from autotune.text_files import LONGEST_TEXT_BYTES, printable, read_json, read_text, read_toml


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_comes_in_from_every_encoding_that_says_what_it_is(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes('name = "Behälter 20 °C"\r\n'.encode(encoding))
    assert read_toml(path) == {"name": "Behälter 20 °C"}


@pytest.mark.parametrize("encoding", ["cp1252", "latin-1"])
def test_a_file_of_an_old_code_page_is_refused_with_its_line_and_the_remedy(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes('a = 1\n# Behälter\nb = "°C"\n'.encode(encoding))
    with pytest.raises(InputError, match=r"line 2 is not UTF-8 \(byte 0xE4, in cp1252 'ä'\); save the file as UTF-8"):
        read_toml(path)


@pytest.mark.parametrize("depth", [40, 1_000, 100_000])
def test_a_file_nested_without_end_is_refused(tmp_path: Path, depth: int) -> None:
    path = tmp_path / "a.json"
    path.write_text("[" * depth + "]" * depth)
    with pytest.raises(InputError, match="nested deeper"):
        read_json(path)
    path.write_text("a = " + "[" * depth + "]" * depth)
    with pytest.raises(InputError, match="nested deeper"):
        read_toml(path)


@pytest.mark.parametrize("word", ["NaN", "Infinity", "-Infinity"])
def test_json_has_no_word_for_what_is_no_number(tmp_path: Path, word: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(f'{{"K": {word}}}')
    with pytest.raises(InputError, match="is no number of JSON"):
        read_json(path)


@pytest.mark.parametrize("text", ["\\u001b[2J", "\\u0007", "\\u202e"])
def test_no_text_of_a_file_can_command_a_terminal_or_turn_its_direction(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(f'name = "{text}"\n')
    with pytest.raises(InputError, match="control character") as refused:
        read_toml(path)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("digits", [32, 400, 10_000])
def test_an_integer_that_no_arithmetic_holds_is_refused(tmp_path: Path, digits: int) -> None:
    path = tmp_path / "a.toml"
    path.write_text(f"a = {'9' * digits}\n")
    with pytest.raises(InputError, match="not TOML"):
        read_toml(path)


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "", "nowhere/a.toml"])
def test_a_name_that_no_file_can_have_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_text(name)


def test_a_file_without_end_is_read_up_to_the_bound_only() -> None:
    with pytest.raises(InputError, match=f"longer than {LONGEST_TEXT_BYTES >> 20} MiB"):
        read_text("/dev/zero")


def test_control_characters_are_written_out() -> None:
    assert printable("a\x1b[31mb\nc") == "a\\x1b[31mb\\nc"
    assert printable("Behälter °C") == "Behälter °C"
