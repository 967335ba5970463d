"""Requests that the server of a page answers, and resources that a page in a file loads."""

from __future__ import annotations

import subprocess

import pytest
from test_browser import CHROMIUM, is_blue, screenshot

import diffcloth_torch as dc
from diffcloth_torch.viewers import guard
from diffcloth_torch.viewers.browser import Browser

viser = pytest.importorskip("viser")
client = pytest.importorskip("websockets.sync.client")

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(scope="module")
def states():
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(9, 9)]), 0.01)
    return sim.scene, [sim.initial_state(), *sim.rollout(sim.initial_state(), steps=3)]


@pytest.fixture(scope="module")
def browser(states):
    scene, shown = states
    page = Browser(scene, port=8490)
    page.show(shown[0])
    yield page
    page.close()


@pytest.fixture(scope="module")
def port(browser):
    return int(browser.url.rpartition(":")[2])


def status(port, headers, path="/"):
    """HTTP status of a request with some headers, and its first lines."""
    import socket

    lines = [f"GET {path} HTTP/1.1", *(f"{name}: {value}" for name, value in headers)]
    with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
        connection.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        answer = b""
        while b"\r\n\r\n" not in answer and (data := connection.recv(4096)):
            answer += data
    head = answer.partition(b"\r\n\r\n")[0].decode()
    return int(head.split()[1]), head


OPEN = [
    ("Connection", "Upgrade"), ("Upgrade", "websocket"), ("Sec-WebSocket-Version", "13"),
    ("Sec-WebSocket-Key", "dGhlIHNhbXBsZSBub25jZQ=="),
]  # fmt: skip


@pytest.mark.parametrize(
    ("host", "origin", "answered"),
    [
        ("localhost:{port}", "http://localhost:{port}", True),
        ("127.0.0.1:{port}", "http://127.0.0.1:{port}", True),
        ("[::1]:{port}", "http://[::1]:{port}", True),
        ("localhost:9000", "http://localhost:9000", True),  # by a tunnel
        ("localhost:{port}", "http://localhost:3000", False),  # another server of this machine
        ("localhost:{port}", "http://127.0.0.1:{port}", False),
        ("localhost:{port}", "http://evil.example", False),
        ("localhost:{port}", "null", False),
        ("localhost:{port}", "", False),
        ("localhost:{port}", None, False),
        ("evil.example:{port}", "http://evil.example:{port}", False),  # a name that is rebound
        ("127.0.0.1.evil.example", "http://127.0.0.1.evil.example", False),
        ("localhost@evil.example", "http://localhost@evil.example", False),
        ("192.0.2.7:{port}", "http://192.0.2.7:{port}", False),
        ("[", "http://[", False),
    ],
)
def test_a_websocket_opens_for_the_page_alone(port, host, origin, answered):
    headers = [("Host", host.format(port=port)), *OPEN]
    if origin is not None:
        headers.append(("Origin", origin.format(port=port)))
    assert status(port, headers)[0] == (101 if answered else 403)


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        ([("Host", "localhost:1")], 200),
        ([("Host", "evil.example")], 403),
        ([], 403),
        ([("Host", "localhost"), ("Host", "evil.example")], 403),
        ([("Host", "localhost:1"), ("Origin", "http://evil.example")], 403),
        ([("Host", "localhost:1"), ("Origin", "http://localhost:1")], 200),
        ([("Host", "localhost:1"), ("Upgrade", "WebSocket")], 403),
    ],
)
def test_the_page_comes_for_its_host_alone(port, headers, expected):
    found, head = status(port, headers)
    assert found == expected
    if expected == 200:
        assert "frame-ancestors 'self'" in head


def test_a_server_for_a_network_answers_addresses_and_its_own_name():
    for name in ("192.0.2.7:80", "[2001:db8::1]:80", "robot:80", "localhost"):
        assert guard._is_own("robot", name) == guard._is_own("Robot", name) is True
    assert not guard._is_own("0.0.0.0", "evil.example")


def test_nothing_makes_the_server_public(browser):
    """Viser's request for a tunnel has no handler, and the page has no button for a tunnel."""
    server = browser._server._websock_server
    known = {kind.__name__ for kind, handlers in server._incoming_handlers.items() if handlers}
    assert known  # of sliders and check boxes
    assert not {name for name in known if name.startswith("ShareUrl")}
    sent = server._broadcast_buffer.message_from_id.values()
    (theme,) = [m for m in sent if type(m).__name__ == "ThemeConfigurationMessage"]
    assert theme.show_share_button is False


def test_a_version_of_viser_that_cannot_be_guarded_is_refused(monkeypatch):
    stopped = []

    class Server:
        def __init__(self, *arguments, **options):
            pass

        def stop(self):
            stopped.append(True)

    monkeypatch.setattr(viser, "ViserServer", Server)
    with pytest.raises(dc.InvalidInput, match="would answer any page"):
        guard.guarded_server(viser, "127.0.0.1", 8491)
    assert stopped == [True]


def console(page, folder):
    """Console messages of a page without a network; a policy violation is one message."""
    result = subprocess.run(
        [
            CHROMIUM, "--headless=new", "--no-sandbox", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader", "--disable-dev-shm-usage",
            "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={folder}/profile",
            "--enable-logging=stderr", "--virtual-time-budget=4000",
            f"--screenshot={folder}/console.png", page.as_uri(),
        ],
        check=True, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    return [line for line in result.stderr.splitlines() if ":CONSOLE:" in line]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_page_in_a_file_loads_nothing(states, tmp_path):
    scene, shown = states
    page = tmp_path / "page.html"
    dc.show(scene, shown, page)
    try:
        image = screenshot(page.as_uri(), tmp_path / "page.png", 4)
        messages = console(page, tmp_path)
    except subprocess.SubprocessError as error:
        pytest.skip(f"Chromium cannot start here: {error}")
    assert is_blue(image).sum() > 1500
    assert not [m for m in messages if "Content Security Policy" in m], messages
    # The policy forbids the image and logs a violation.
    text = page.read_text()
    page.write_text(text.replace("</body>", "<img src='http://192.0.2.7/a.png'></body>"))
    assert [m for m in console(page, tmp_path) if "Content Security Policy" in m]
