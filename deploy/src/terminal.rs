//! The terminal in which a command was started. A closed terminal is not an error, since the run must not end because
//! of its progress bar. `display` draws its progress bars through [`progress_target`].

use std::fs::File;
use std::io::{self, IsTerminal, Write};
use std::os::fd::BorrowedFd;
use std::os::unix::fs::FileTypeExt;
use std::sync::{Mutex, PoisonError};

use indicatif::{ProgressDrawTarget, TermLike};
use rustix::io::Errno;

/// Most redraws per second.
const MAX_REDRAW_HZ: u8 = 20;
/// Default columns and lines, if the terminal reports none.
const DEFAULT_SIZE: (u16, u16) = (80, 24);

/// The target of progress bars: standard error, or hidden if that is not a terminal that can draw them.
pub(crate) fn progress_target() -> ProgressDrawTarget {
    let is_dumb = std::env::var_os("TERM").is_none_or(|kind| kind == "dumb");
    if io::stderr().is_terminal() && !is_dumb {
        ProgressDrawTarget::term_like_with_hz(Box::new(Terminal::default()), MAX_REDRAW_HZ)
    } else {
        ProgressDrawTarget::hidden()
    }
}

/// Columns of the terminal of standard error.
pub(crate) fn columns() -> usize {
    Terminal::size().0.into()
}

/// Whether standard output is a terminal on which the user wants colours; NO_COLOR disables them. Unlike progress bars,
/// colours do not need TERM to be set.
pub(crate) fn shows_colours() -> bool {
    let is_dumb = std::env::var_os("TERM").is_some_and(|kind| kind == "dumb");
    let is_disabled = std::env::var_os("NO_COLOR").is_some_and(|set| !set.is_empty());
    io::stdout().is_terminal() && !is_dumb && !is_disabled
}

/// Whether `error`, from writing to `output`, means that its pipe or terminal is closed.
pub(crate) fn is_closed_output(error: &io::Error, output: BorrowedFd<'_>) -> bool {
    // A closed terminal does not pass `isatty`, but its file is still a character device.
    let is_device = || {
        let copy = output.try_clone_to_owned().map(File::from);
        copy.and_then(|file| file.metadata())
            .is_ok_and(|metadata| metadata.file_type().is_char_device())
    };
    let is_hung_up = Errno::from_io_error(error) == Some(Errno::IO) && is_device();
    error.kind() == io::ErrorKind::BrokenPipe || is_hung_up
}

/// Standard error as a terminal that writes each drawing with one call. Holds the drawing until it is flushed.
#[derive(Debug, Default)]
struct Terminal(Mutex<String>);

impl Terminal {
    /// Adds `text` to the drawing, which [`TermLike::flush`] writes.
    #[expect(clippy::unnecessary_wraps, reason = "the trait requires a result")]
    fn buffer(&self, text: &str) -> io::Result<()> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push_str(text);
        Ok(())
    }

    /// Moves the cursor by `n` in the direction of the escape `code`: A up, B down, C right, D left.
    fn move_cursor(&self, n: usize, code: char) -> io::Result<()> {
        if n == 0 {
            Ok(())
        } else {
            self.buffer(&format!("\u{1b}[{n}{code}"))
        }
    }

    /// The number of columns and lines.
    fn size() -> (u16, u16) {
        let size = rustix::termios::tcgetwinsize(io::stderr()).map(|size| (size.ws_col, size.ws_row));
        size.ok()
            // A size of 0 means that the terminal does not know it.
            .filter(|&(columns, lines)| columns > 0 && lines > 0)
            .unwrap_or(DEFAULT_SIZE)
    }
}

impl TermLike for Terminal {
    fn width(&self) -> u16 {
        Self::size().0
    }

    fn height(&self) -> u16 {
        Self::size().1
    }

    fn move_cursor_up(&self, n: usize) -> io::Result<()> {
        self.move_cursor(n, 'A')
    }

    fn move_cursor_down(&self, n: usize) -> io::Result<()> {
        self.move_cursor(n, 'B')
    }

    fn move_cursor_right(&self, n: usize) -> io::Result<()> {
        self.move_cursor(n, 'C')
    }

    fn move_cursor_left(&self, n: usize) -> io::Result<()> {
        self.move_cursor(n, 'D')
    }

    fn write_line(&self, text: &str) -> io::Result<()> {
        self.buffer(text)?;
        self.buffer("\n")
    }

    fn write_str(&self, text: &str) -> io::Result<()> {
        self.buffer(text)
    }

    fn clear_line(&self) -> io::Result<()> {
        self.buffer("\r\u{1b}[2K")
    }

    fn flush(&self) -> io::Result<()> {
        let drawing = std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        // indicatif unwraps errors, so one of a closed terminal would end the run.
        let _gone = io::stderr().write_all(drawing.as_bytes()).is_err();
        Ok(())
    }
}
