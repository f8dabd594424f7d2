"""Errors of the viewer."""

from __future__ import annotations

_NEEDS = {
    "meshcat": ("the viewer needs", "viewer"),
    "embreex": ('pictures (render_mode="rgb_array") need', "video"),
    "imageio-ffmpeg": ("videos need", "video"),
}


class ViewerError(RuntimeError):
    """A rollout cannot be shown; the message is one line."""

    @classmethod
    def missing(cls, package: str) -> ViewerError:
        """Return the error for a package that is not installed, with the command that installs it."""
        purpose, extra = _NEEDS[package]
        return cls(f'{purpose} {package}, which is not installed: pip install "ce_gym[{extra}]"')
