from __future__ import annotations

import base64
import hashlib
import re

from persist_cli.play.walking_page import walking_page


def inline(tag: str) -> str:
    """What stands in the one element of this tag."""
    (text,) = re.findall(rf"<{tag}[^>]*>(.*?)</{tag}>", walking_page().html, re.DOTALL)
    return str(text)


def test_the_page_needs_no_other_file() -> None:
    html = walking_page().html
    addresses = set(re.findall(r"""(?:src|href)=["']([^"']{5})|url\(([^)]{5})|@import|(https?://)""", html))
    assert addresses <= {("data:", "", ""), ("", "", "http://")}  # the icon, and the name of its language
    assert html.count("http://") == html.count("http://www.w3.org/2000/svg")


def test_the_policy_allows_this_style_and_this_script_alone() -> None:
    for tag in ("style", "script"):
        digest = base64.b64encode(hashlib.sha256(inline(tag).encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}';" in walking_page().policy
    assert walking_page().policy.startswith("default-src 'none'; ")


def test_no_element_has_a_style_or_a_handler_that_the_policy_forbids() -> None:
    markup = walking_page().html.replace(inline("style"), "").replace(inline("script"), "")
    assert not re.findall(r"\s(?:style|on\w+)=", markup)


def test_the_script_finds_each_element_that_it_names() -> None:
    ids = set(re.findall(r'id="([a-z-]+)"', walking_page().html))
    commands = set(re.findall(r'^  \["([a-z]+)", "', inline("script"), re.MULTILINE))
    assert len(commands) == 7
    assert set(re.findall(r'byId\("([a-z-]+)"\)', inline("script"))) <= ids | commands


def test_each_button_and_field_has_words_for_those_who_do_not_see_it() -> None:
    html = walking_page().html
    fields = re.findall(r'<input[^>]* id="([a-z-]+)"', html)
    labelled = [
        name for name in fields if f'for="{name}"' in html or re.search(rf'<label[^>]*><input[^>]* id="{name}"', html)
    ]
    assert fields == labelled == ["steps", "guidance", "autoguidance", "seed", "ahead"]
