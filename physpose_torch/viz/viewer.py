"""Poses in the browser: the objects on their table at every step of a refinement, by viser (extra ``viz``)."""

import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from physpose_torch.errors import InvalidInputError, MissingExtraError
from physpose_torch.report import NOTABLE
from physpose_torch.viz.nodes import SceneNodes, field_of_view, quaternion_position
from physpose_torch.viz.viewed import ViewedImage

if TYPE_CHECKING:
    import viser

__all__ = ["PoseViewer", "load_viser", "serve"]


class PoseViewer:
    """A web page with images to step through, the steps of each refinement on a slider, and the report.

    Nodes are ``/objects/K/surface``, ``red`` (where it is inside something), ``parts`` (convex), ``/initial/K`` (a ghost at
    the first step), ``/statics/K``, ``/table`` and ``/camera``; z points up. Close it, or use it as a context manager.

    Args:
        images: what to show; a sequence that makes its items when they are asked for will do.
        names: one an image; None: the images' own, which makes all of them.
        host: address to listen at; ``0.0.0.0`` lets other machines in.
        port: to listen at, or the next one that is free; 0: any.
        rate: steps a second while it plays.

    Raises:
        InvalidInputError: no image, or another number of names.
        MissingExtraError: viser is not installed.
    """

    def __init__(
        self,
        images: Sequence[ViewedImage],
        *,
        names: Sequence[str] | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        rate: float = 12.0,
    ) -> None:
        if len(images) == 0:
            raise InvalidInputError("there is no image to view")
        if not rate > 0:
            raise InvalidInputError(f"rate = {rate}, expected a positive number of steps a second")
        names = [image.name for image in images] if names is None else list(names)
        if len(names) != len(images):
            raise InvalidInputError(f"{len(names)} names for {len(images)} images")
        self.images, self.names, self.rate = images, names, rate
        self._lock = threading.RLock()  # viser calls back from many threads
        self._ticket: object | None = None  # of the thread that may play
        self._closed = threading.Event()
        self._player: threading.Thread | None = None
        self._changing = False
        self.server = load_viser().ViserServer(host=host, port=port, label="physpose", verbose=False)
        try:
            self._build_controls()
            self.show_image(0)
        except BaseException:
            self.server.stop()
            raise

    # ---- what can be done with it

    @property
    def url(self) -> str:
        """Where the page is."""
        host = self.server.get_host()
        return f"http://{'localhost' if host in ('0.0.0.0', '127.0.0.1') else host}:{self.server.get_port()}"

    def show_image(self, index: int) -> None:
        """Show an image, at the last step."""
        with self._lock:
            self.pause()
            self.index, self.viewed = index, self.images[index]
            viewed = self.viewed
            with self.server.atomic():
                self._nodes = SceneNodes(self.server, viewed)
                self._changing = True  # the slider's own callback has nothing to do
                self.image.value = self.names[index]
                self.step.max = max(viewed.last, 1)
                self.step.value = viewed.last
                self._changing = False
                self.step.disabled = self.play.disabled = viewed.last == 0
                self.show_step(viewed.last)

    def show_step(self, step: int) -> None:
        """Show a step of the refinement of the image at hand."""
        with self._lock, self.server.atomic():
            if not 0 <= step <= self.viewed.last:
                raise InvalidInputError(f"step {step}, expected 0 to {self.viewed.last}")
            self.shown = step
            self._nodes.move(step)
            self.table.content = self.viewed.table(step)
            self._show()

    def start(self) -> None:
        """Play the steps from the one at hand, or from the first one if it is the last."""
        with self._lock:
            if self._ticket is not None or self.viewed.last == 0:
                return
            if self.shown == self.viewed.last:
                self.step.value = 0
            self._ticket = object()
            self.play.label = "pause"
            self._player = threading.Thread(
                target=self._play, args=(self._ticket,), name="physpose-player", daemon=True
            )
            self._player.start()

    def pause(self) -> None:
        """Stop playing."""
        self._ticket = None
        self.play.label = "play"

    def look_through(self, client: Any) -> None:
        """Move a browser's camera to where the image was taken; the pyramid would be in the way."""
        viewed = self.viewed
        if viewed.K is None:
            return
        self.show["camera"].value = False
        T = viewed.T_world_camera
        client.camera.wxyz, client.camera.position = quaternion_position(T)
        client.camera.fov = field_of_view(viewed)

    def wait(self, timeout: float | None = None) -> bool:
        """Until it is closed; False if that took longer than ``timeout`` seconds."""
        return self._closed.wait(timeout)

    def close(self) -> None:
        """Stop playing and serving."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._ticket = None
        if self._player is not None and self._player is not threading.current_thread():
            self._player.join(timeout=5)
        self.server.stop()

    def __enter__(self) -> "PoseViewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- controls

    def _build_controls(self) -> None:
        gui = self.server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self.image = gui.add_dropdown("image", tuple(self.names), initial_value=self.names[0])
        self.image.visible = len(self.names) > 1
        self.turn = gui.add_button_group("turn to", ("previous", "next"))
        self.turn.visible = len(self.names) > 1
        self.step = gui.add_slider(
            "step", min=0, max=1, step=1, initial_value=0, hint="of the refinement; 0: as estimated"
        )
        self.play = gui.add_button("play")
        with gui.add_folder("show"):
            self.show = {
                "initial": gui.add_checkbox("ghosts", False, hint="the objects at the first step, as estimated"),
                "parts": gui.add_checkbox("convex parts", False, hint="what distances are measured between"),
                "red": gui.add_checkbox("red", True, hint=f"what is more than {1e3 * NOTABLE:.0f} mm inside something"),
                "table": gui.add_checkbox("table", True),
                "camera": gui.add_checkbox("camera", True, hint="with its image, if there is one"),
            }
            look = gui.add_button("look through the camera")
        self.table = gui.add_markdown("")

        self.image.on_update(lambda _: None if self._changing else self.show_image(self.names.index(self.image.value)))
        self.turn.on_click(self._turn)
        self.step.on_update(lambda _: self._slid())
        self.play.on_click(lambda _: self.start() if self._ticket is None else self.pause())
        look.on_click(lambda event: None if event.client is None else self.look_through(event.client))
        for box in self.show.values():
            box.on_update(lambda _: self._show())

    def _turn(self, _: object) -> None:
        self.show_image((self.index + (1 if self.turn.value == "next" else -1)) % len(self.names))

    def _slid(self) -> None:
        with self._lock:  # the slider may still be that of the image before
            if not self._changing and int(self.step.value) != self.shown:
                self.show_step(min(int(self.step.value), self.viewed.last))

    def _play(self, ticket: object) -> None:
        while not self._closed.wait(1 / self.rate):
            with self._lock:
                if self._ticket is not ticket:
                    return
                if self.shown >= self.viewed.last:
                    self.pause()
                    return
                self.step.value = self.shown + 1  # whose callback shows it

    def _show(self) -> None:
        with self._lock, self.server.atomic():
            wrong = self.viewed.penetrating(self.shown) if len(self.viewed.scene) else []
            self._nodes.show(wrong, **{name: box.value for name, box in self.show.items()})


def serve(viewer: PoseViewer) -> None:
    """Serve until Ctrl-C, or until the viewer is closed."""
    try:
        while not viewer.wait(0.5):
            pass
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()


def load_viser() -> "viser":
    """The package.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingExtraError(f'the viewer needs viser ({error}); pip install "physpose-torch[viz]"') from error
    return viser
