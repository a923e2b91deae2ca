//! The growing tables of a run folder. Only whole rows reach the file, each within a second, so that a killed run keeps
//! its rows so far (`docs/command-line.md`). `run_folder` uses it for `events.csv` and `windows.csv`.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

/// Longest delay of a row.
const WRITE_INTERVAL: Duration = Duration::from_secs(1);
/// Held bytes from which the next write to a [`LineBuffered`] writes them out first.
const MAX_HELD_BYTES: usize = 1 << 16;

/// Tables whose rows are written within a second.
pub(crate) struct TableWriter {
    state: Arc<Mutex<TableWriterState>>,
    /// Writes the pending rows.
    thread: Option<JoinHandle<()>>,
}

/// State shared by the run and the thread.
struct TableWriterState {
    tables: Vec<csv::Writer<LineBuffered<File>>>,
    /// The first error; no rows are added after it.
    error: Option<csv::Error>,
    is_over: bool,
}

impl TableWriter {
    /// Creates tables in `folder`, each with a name and its columns.
    ///
    /// # Errors
    /// If a table cannot be written, or the thread cannot be started.
    pub(crate) fn begin(folder: &Path, tables: &[(&str, Vec<&str>)]) -> anyhow::Result<Self> {
        let mut writers = Vec::new();
        for (name, columns) in tables {
            let mut table = csv::Writer::from_writer(LineBuffered::new(File::create(folder.join(name))?));
            table.write_record(columns)?;
            writers.push(table);
        }
        let state = Arc::new(Mutex::new(TableWriterState {
            tables: writers,
            error: None,
            is_over: false,
        }));
        let thread_state = Arc::clone(&state);
        let write_loop = move || {
            loop {
                std::thread::park_timeout(WRITE_INTERVAL);
                let mut state = lock(&thread_state);
                state.write_out();
                // Checked after the write, so that the last rows are written too.
                if state.is_over {
                    return;
                }
            }
        };
        let thread = std::thread::Builder::new()
            .name("tables".to_owned())
            .spawn(write_loop)?;
        Ok(Self {
            state,
            thread: Some(thread),
        })
    }

    /// Adds a row, with one cell per column, to the table with this index in the list of [`Self::begin`]. An error
    /// shows in [`Self::has_no_error`] and [`Self::flush`]; later rows are then dropped.
    ///
    /// # Panics
    /// If there is no such table.
    pub(crate) fn add<R>(&self, table_index: usize, row: R)
    where
        R: IntoIterator,
        R::Item: AsRef<[u8]>,
    {
        let mut state = lock(&self.state);
        if state.error.is_none() {
            state.error = state.tables[table_index].write_record(row).err();
        }
    }

    /// Whether no write has failed so far.
    pub(crate) fn has_no_error(&self) -> bool {
        lock(&self.state).error.is_none()
    }

    /// Writes all pending rows. Call it at the end of the run: it takes the error out of the writer.
    ///
    /// # Errors
    /// If a write fails now or failed before.
    pub(crate) fn flush(&self) -> Result<(), csv::Error> {
        let mut state = lock(&self.state);
        state.write_out();
        state.error.take().map_or(Ok(()), Err)
    }
}

impl Drop for TableWriter {
    fn drop(&mut self) {
        lock(&self.state).is_over = true;
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _panicked = thread.join().is_err();
        }
    }
}

fn lock(state: &Mutex<TableWriterState>) -> MutexGuard<'_, TableWriterState> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

impl TableWriterState {
    /// Writes the whole rows of every table to its file.
    fn write_out(&mut self) {
        for table in &mut self.tables {
            // The first error names the cause; later ones follow from it.
            if let (Err(error), None) = (table.flush(), &self.error) {
                self.error = Some(error.into());
            }
        }
    }
}

/// Holds bytes back until they form whole lines.
struct LineBuffered<W> {
    file: W,
    /// Bytes that are not written yet.
    held: Vec<u8>,
}

impl<W: Write> LineBuffered<W> {
    fn new(file: W) -> Self {
        Self { file, held: Vec::new() }
    }

    /// Writes the whole lines held back.
    fn write_lines(&mut self) -> io::Result<()> {
        let mut unwritten = self.held.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
        // Not `write_all`: bytes that a full disk has taken must not be written again once there is room.
        while unwritten > 0 {
            match self.file.write(&self.held[..unwritten]) {
                Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                Ok(written) => {
                    self.held.drain(..written);
                    unwritten -= written;
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}

impl<W: Write> Write for LineBuffered<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        // Written before `bytes` are taken: after an error, the CSV writer passes the same bytes again.
        if self.held.len() >= MAX_HELD_BYTES {
            self.write_lines()?;
        }
        self.held.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.write_lines()?;
        self.file.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file that keeps the bytes of each write.
    #[derive(Default)]
    struct Writes(Vec<Vec<u8>>);

    impl Write for Writes {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.push(bytes.to_vec());
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn writes_contain_only_complete_rows() {
        let mut buffered = LineBuffered::new(Writes::default());
        // 100 rows and the start of the next.
        let rows = [b"1,2,3\n".repeat(100), b"4,".to_vec()].concat();
        for _ in 0..400 {
            buffered.write_all(&rows).expect("taken");
        }
        assert!(buffered.held.len() < MAX_HELD_BYTES);
        buffered.flush().expect("written");
        assert_eq!(buffered.held, b"4,", "an incomplete row is held back");
        buffered.write_all(b"5\n").expect("taken");
        buffered.flush().expect("written");
        let writes = &buffered.file.0;
        assert!(writes.len() > 3, "rows are written before the flush");
        let has_complete_rows = |bytes: &Vec<u8>| bytes.is_empty() || bytes.ends_with(b"\n");
        assert!(writes.iter().all(has_complete_rows));
        let expected = [rows.repeat(400), b"5\n".to_vec()].concat();
        assert_eq!(writes.concat(), expected);
    }

    /// A file that refuses the first write, like a full disk, and keeps later ones.
    #[derive(Default)]
    struct FullAtFirstWrite {
        has_refused: bool,
        bytes: Vec<u8>,
    }

    impl Write for FullAtFirstWrite {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            if !std::mem::replace(&mut self.has_refused, true) {
                return Err(io::ErrorKind::StorageFull.into());
            }
            self.bytes.extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn bytes_of_a_failed_write_are_written_once() {
        let mut buffered = LineBuffered::new(FullAtFirstWrite::default());
        let rows = b"1,2,3\n".repeat(MAX_HELD_BYTES);
        buffered.write_all(&rows).expect("held");
        buffered.write_all(b"4,5,6\n").expect_err("the disk is full");
        // The CSV writer keeps the bytes of a failed write and passes them again.
        buffered.write_all(b"4,5,6\n").expect("there is room now");
        buffered.flush().expect("written");
        assert_eq!(buffered.file.bytes, [rows.as_slice(), b"4,5,6\n"].concat());
    }
}
