"""What operators that run mocapfix have in common: progress, cancelling, and errors as one sentence."""

import shutil
from collections.abc import Callable
from pathlib import Path

import bpy

from .preferences import get_executable
from .process import CleaningProcess, ProcessError

TIMER_INTERVAL_S = 0.1


class ProcessOperator:
    """Runs `mocapfix clean`, in the background if there is a window, and then calls `finish`.

    Subclasses are operators that implement `finish(context, process)`, which may raise ProcessError.
    """

    _process: CleaningProcess | None = None
    _timer = None
    report: Callable[[set[str], str], None]

    def start(self, context, arguments: list[str], temporary: Path, output_folder: Path | None = None) -> set[str]:
        """Start the process; without a window wait for it and finish. Arguments are those of CleaningProcess."""
        try:
            process = CleaningProcess(get_executable(context), arguments, temporary, output_folder)
        except ProcessError as error:
            shutil.rmtree(temporary, ignore_errors=True)
            return self.fail(error)
        if not self.has_window(context):
            process.wait()
            return self._end(context, process)
        self._process = process
        manager = context.window_manager
        self._timer = manager.event_timer_add(TIMER_INTERVAL_S, window=context.window)
        manager.progress_begin(0, 100)
        manager.modal_handler_add(self)
        self._show_progress(context, process)
        return {"RUNNING_MODAL"}

    def modal(self, context, event) -> set[str]:
        """Follow the process while the user works on; Esc stops it."""
        if event.type == "ESC" and event.value == "PRESS":
            self.cancel(context)
            self.report({"WARNING"}, "Cancelled: mocapfix was stopped and nothing was changed.")
            return {"CANCELLED"}
        if event.type != "TIMER" or self._process is None:
            return {"PASS_THROUGH"}
        if not self._process.poll():
            self._show_progress(context, self._process)
            return {"PASS_THROUGH"}
        self._hide_progress(context)
        process, self._process = self._process, None
        return self._end(context, process)

    def cancel(self, context) -> None:
        """Stop the process; Blender calls this also when it closes or opens another file."""
        self._hide_progress(context)
        if self._process is not None:
            self._process.cancel()
            self._process = None

    def has_window(self, context) -> bool:
        """Return whether there is a window in which progress can be shown."""
        return not bpy.app.background and context.window is not None

    def finish(self, context, process: CleaningProcess) -> None:
        """Bring the results of the ended process into the scene."""
        raise NotImplementedError

    def fail(self, error: ProcessError) -> set[str]:
        """Report an error as one sentence."""
        self.report({"ERROR"}, str(error))
        return {"CANCELLED"}

    def _end(self, context, process: CleaningProcess) -> set[str]:
        try:
            process.check_result()
            self.finish(context, process)
        except ProcessError as error:
            return self.fail(error)
        except RuntimeError as error:  # of an operator of Blender
            reason = str(error).strip().partition("\n")[0]
            return self.fail(ProcessError(f"Blender cannot edit the scene ({reason}); leave other modes and try again."))
        finally:
            process.remove_files()
        return {"FINISHED"}

    def _show_progress(self, context, process: CleaningProcess) -> None:
        context.window_manager.progress_update(round(100 * process.fraction))
        context.workspace.status_text_set(f"mocapfix: {process.stage_text} (Esc cancels)")

    def _hide_progress(self, context) -> None:
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            context.window_manager.progress_end()
            self._timer = None
            if context.workspace is not None:
                context.workspace.status_text_set(None)
