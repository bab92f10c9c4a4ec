"""A window that shows pictures as they come: pygame, loaded only where one is asked for."""

import os
from typing import Any

from tangram_core.arrays import Pixels
from tangram_core.errors import ConfigError

_DRIVER = "SDL_VIDEODRIVER"
_UNSEEN = ("dummy", "offscreen")  # what SDL takes where there is no display


class Screen:
    """A window, opened by its first picture."""

    def __init__(self, title: str, fps: int) -> None:
        """Look whether a window can be shown; ConfigError without pygame, or without a display."""
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it greets on stdout
        try:
            import pygame  # noqa: PLC0415 - optional
        except ImportError:
            raise ConfigError(
                "render_mode=human needs pygame, which is missing: pip install "
                "'tangram-rl[human]', or take render_mode=rgb_array"
            ) from None
        self._pygame: Any = pygame
        self._title, self._fps = title, fps
        self._window: Any = None
        self._open_display()

    def show(self, picture: Pixels) -> None:
        """Show a picture (H, W, 3) for as long as the frame rate has it."""
        pygame = self._pygame
        if self._window is None:
            pygame.display.init()  # another's end may have closed it
            pygame.display.set_caption(self._title)
            self._window = pygame.display.set_mode(picture.shape[1::-1])
            self._clock = pygame.time.Clock()
        pygame.event.pump()
        self._window.blit(pygame.surfarray.make_surface(picture.swapaxes(0, 1)), (0, 0))
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window; calling it twice does no harm."""
        self._pygame.display.quit()
        self._window = None

    def _open_display(self) -> None:
        display, why = self._pygame.display, ""
        try:
            display.init()
        except self._pygame.error as error:
            why = str(error)
        else:
            if display.get_driver() in _UNSEEN and not os.environ.get(_DRIVER):
                display.quit()
                why = "SDL finds none"
        if why:
            raise ConfigError(
                f"render_mode=human needs a display ({why}): log in with one, set {_DRIVER}, or "
                "take render_mode=rgb_array"
            )
