//! The terminal that a command was started in. One that is gone, as its window was closed, is no error: the run
//! matters, and is not to end in the middle of a drawing.

use std::fs::File;
use std::io::{self, IsTerminal, Write};
use std::os::fd::BorrowedFd;
use std::os::unix::fs::FileTypeExt;
use std::sync::{Mutex, PoisonError};

use indicatif::{ProgressDrawTarget, TermLike};
use rustix::io::Errno;

/// Drawings a second at the most.
const RATE: u8 = 20;
/// Columns and lines where the terminal does not say.
const USUAL: (u16, u16) = (80, 24);

/// Where bars are drawn: on standard error, or nowhere if that is no terminal that bars can be drawn on.
pub fn target() -> ProgressDrawTarget {
    let is_dumb = std::env::var_os("TERM").is_none_or(|kind| kind == "dumb");
    if io::stderr().is_terminal() && !is_dumb {
        ProgressDrawTarget::term_like_with_hz(Box::new(Terminal::default()), RATE)
    } else {
        ProgressDrawTarget::hidden()
    }
}

/// Whether `error`, of writing to `output`, means that nobody reads it any more: the pipe or the terminal is closed.
pub fn is_gone(error: &io::Error, output: BorrowedFd<'_>) -> bool {
    // A terminal that is gone is none any more, but a device still.
    let is_device = || {
        let copy = output.try_clone_to_owned().map(File::from);
        copy.and_then(|file| file.metadata())
            .is_ok_and(|found| found.file_type().is_char_device())
    };
    let is_hung_up = Errno::from_io_error(error) == Some(Errno::IO) && is_device();
    error.kind() == io::ErrorKind::BrokenPipe || is_hung_up
}

/// Standard error as a terminal, which takes a drawing as a whole.
#[derive(Debug, Default)]
struct Terminal(Mutex<String>);

impl Terminal {
    #[expect(clippy::unnecessary_wraps, reason = "that is what a terminal answers")]
    fn add(&self, text: &str) -> io::Result<()> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push_str(text);
        Ok(())
    }

    /// Moves the cursor by `n` in the direction that `code` stands for.
    fn go(&self, n: usize, code: char) -> io::Result<()> {
        if n == 0 {
            Ok(())
        } else {
            self.add(&format!("\u{1b}[{n}{code}"))
        }
    }

    /// Columns and lines.
    fn size() -> (u16, u16) {
        let size = rustix::termios::tcgetwinsize(io::stderr()).map(|size| (size.ws_col, size.ws_row));
        size.ok()
            .filter(|&(columns, lines)| columns > 0 && lines > 0)
            .unwrap_or(USUAL)
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
        self.go(n, 'A')
    }

    fn move_cursor_down(&self, n: usize) -> io::Result<()> {
        self.go(n, 'B')
    }

    fn move_cursor_right(&self, n: usize) -> io::Result<()> {
        self.go(n, 'C')
    }

    fn move_cursor_left(&self, n: usize) -> io::Result<()> {
        self.go(n, 'D')
    }

    fn write_line(&self, text: &str) -> io::Result<()> {
        self.add(text)?;
        self.add("\n")
    }

    fn write_str(&self, text: &str) -> io::Result<()> {
        self.add(text)
    }

    fn clear_line(&self) -> io::Result<()> {
        self.add("\r\u{1b}[2K")
    }

    fn flush(&self) -> io::Result<()> {
        let drawing = std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        let _gone = io::stderr().write_all(drawing.as_bytes()).is_err();
        Ok(())
    }
}
