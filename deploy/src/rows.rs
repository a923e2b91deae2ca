//! The tables of a run folder that grow while the run goes. Whole rows alone reach the file, each within a second, so
//! that a run that is killed has its rows up to then.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

/// The longest that a row waits to be written.
const WAIT: Duration = Duration::from_secs(1);
/// Bytes that wait at the most.
const HELD: usize = 1 << 16;

/// Tables, each row of which is on its way to the disk within a second.
pub struct Tables {
    state: Arc<Mutex<State>>,
    /// Writes what waits.
    thread: Option<JoinHandle<()>>,
}

/// What the run and the thread both work on.
struct State {
    tables: Vec<csv::Writer<Whole<File>>>,
    /// The first that happened; nothing is added after it.
    error: Option<csv::Error>,
    is_over: bool,
}

impl Tables {
    /// Begins tables in `folder`, each a name and its columns.
    ///
    /// # Errors
    /// One cannot be written, or no thread started.
    pub fn begin(folder: &Path, tables: &[(&str, Vec<&str>)]) -> anyhow::Result<Self> {
        let mut open = Vec::new();
        for (name, columns) in tables {
            let mut table = csv::Writer::from_writer(Whole::new(File::create(folder.join(name))?));
            table.write_record(columns)?;
            open.push(table);
        }
        let state = Arc::new(Mutex::new(State {
            tables: open,
            error: None,
            is_over: false,
        }));
        let own = Arc::clone(&state);
        let write = move || {
            loop {
                std::thread::park_timeout(WAIT);
                let mut state = lock(&own);
                state.write_out();
                if state.is_over {
                    return;
                }
            }
        };
        let thread = std::thread::Builder::new().name("tables".to_owned()).spawn(write)?;
        Ok(Self {
            state,
            thread: Some(thread),
        })
    }

    /// Adds a row to the table that was named at place `table`.
    pub fn add<R>(&self, table: usize, row: R)
    where
        R: IntoIterator,
        R::Item: AsRef<[u8]>,
    {
        let mut state = lock(&self.state);
        if state.error.is_none() {
            state.error = state.tables[table].write_record(row).err();
        }
    }

    /// Whether all rows could be written so far.
    pub fn is_well(&self) -> bool {
        lock(&self.state).error.is_none()
    }

    /// Writes all that waits.
    ///
    /// # Errors
    /// Something could not be written, now or before.
    pub fn flush(&self) -> Result<(), csv::Error> {
        let mut state = lock(&self.state);
        state.write_out();
        state.error.take().map_or(Ok(()), Err)
    }
}

impl Drop for Tables {
    fn drop(&mut self) {
        lock(&self.state).is_over = true;
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _panicked = thread.join().is_err();
        }
    }
}

fn lock(state: &Mutex<State>) -> MutexGuard<'_, State> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

impl State {
    fn write_out(&mut self) {
        for table in &mut self.tables {
            if let (Err(error), None) = (table.flush(), &self.error) {
                self.error = Some(error.into());
            }
        }
    }
}

/// Holds bytes back until they are whole lines.
struct Whole<W> {
    file: W,
    held: Vec<u8>,
}

impl<W: Write> Whole<W> {
    fn new(file: W) -> Self {
        Self { file, held: Vec::new() }
    }

    /// Writes the whole lines of what is held.
    fn write_lines(&mut self) -> io::Result<()> {
        let mut left = self.held.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
        // Not all at once: what a full disk has taken in is not written again once there is room.
        while left > 0 {
            match self.file.write(&self.held[..left]) {
                Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                Ok(written) => {
                    self.held.drain(..written);
                    left -= written;
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}

impl<W: Write> Write for Whole<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.held.extend_from_slice(bytes);
        if self.held.len() >= HELD {
            self.write_lines()?;
        }
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

    /// Keeps what each write brought.
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
    fn rows_are_written_whole() {
        let mut whole = Whole::new(Writes::default());
        let row = [b"1,2,3\n".repeat(100), b"4,".to_vec()].concat();
        for _ in 0..400 {
            whole.write_all(&row).expect("taken");
        }
        assert!(whole.held.len() < HELD);
        whole.flush().expect("written");
        assert_eq!(whole.held, b"4,", "half a row waits for its other half");
        whole.write_all(b"5\n").expect("taken");
        whole.flush().expect("written");
        let writes = &whole.file.0;
        assert!(writes.len() > 3, "they do not wait for the end");
        let whole_rows = |bytes: &Vec<u8>| bytes.is_empty() || bytes.ends_with(b"\n");
        assert!(writes.iter().all(whole_rows));
        let all = [row.repeat(400), b"5\n".to_vec()].concat();
        assert_eq!(writes.concat(), all);
    }
}
