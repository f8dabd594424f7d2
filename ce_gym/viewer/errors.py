"""Errors of the viewer."""

from __future__ import annotations


class ViewerError(RuntimeError):
    """A rollout cannot be shown; the message is one line."""

    @classmethod
    def missing_meshcat(cls) -> ViewerError:
        """Return the error for a missing meshcat, with the command that installs it."""
        return cls('the viewer needs meshcat, which is not installed: pip install "ce_gym[viewer]"')

    @classmethod
    def missing_embreex(cls) -> ViewerError:
        """Return the error for a missing embreex, with the command that installs it."""
        return cls(
            'pictures (render_mode="rgb_array") need embreex, which is not installed: pip install "ce_gym[video]"'
        )

    @classmethod
    def missing_ffmpeg(cls) -> ViewerError:
        """Return the error for a missing imageio-ffmpeg, with the command that installs it."""
        return cls('videos need imageio-ffmpeg, which is not installed: pip install "ce_gym[video]"')
