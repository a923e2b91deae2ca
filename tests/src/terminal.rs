//! A terminal in which a command runs and that a test can close like a window, for `tests/program/closed_terminal.rs`.

use std::fs::{File, OpenOptions};
use std::io::Read;
use std::os::fd::OwnedFd;
use std::os::unix::fs::OpenOptionsExt;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::fs::OFlags;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

use crate::process::{PATIENCE, POLL_INTERVAL, now, wait_until};

/// Command in its own terminal; killed on drop.
pub struct PtyCommand {
    child: Child,
    output: Arc<Mutex<Vec<u8>>>,
    /// Whether `reader` must end.
    is_closing: Arc<AtomicBool>,
    /// Thread that collects `output` and keeps the terminal open; `None` after [`Self::close`].
    reader: Option<JoinHandle<()>>,
}

impl PtyCommand {
    /// Starts `command` in a new terminal. It receives SIGHUP when the terminal closes, as from a shell.
    ///
    /// # Panics
    /// If no terminal is available or `setsid` is missing.
    pub fn start(command: &Command) -> Self {
        // SIGHUP goes to the session whose controlling terminal is closed.
        Self::start_in_session(command, &["--ctty"])
    }

    /// Starts `command` in a new terminal. When the terminal closes, its writes fail, and it receives no SIGHUP.
    ///
    /// # Panics
    /// If no terminal is available or `setsid` is missing.
    pub fn start_without_sighup(command: &Command) -> Self {
        Self::start_in_session(command, &[])
    }

    /// Starts `command` in a new terminal and a new session, with these options of `setsid`. Uses the arguments,
    /// variables and working directory of `command`; redirections set there have no effect.
    fn start_in_session(command: &Command, setsid_options: &[&str]) -> Self {
        // Neither end may become the controlling terminal of the test.
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let master = openpt(flags).expect("a terminal is available");
        grantpt(&master).expect("the terminal is ours");
        unlockpt(&master).expect("the terminal is ours");
        let terminal_path = ptsname(&master, Vec::new()).expect("a terminal has a name");
        let terminal = OpenOptions::new()
            .read(true)
            .write(true)
            .custom_flags(OFlags::NOCTTY.bits().cast_signed())
            .open(terminal_path.to_str().expect("a path"))
            .expect("the terminal can be opened");
        let terminal_handle = || Stdio::from(terminal.try_clone().expect("a file can be opened twice"));
        let mut setsid = Command::new("setsid");
        setsid
            .args(setsid_options)
            .arg(command.get_program())
            .args(command.get_args())
            // Without TERM, or on a dumb terminal, the program draws no bars.
            .env("TERM", "xterm");
        for (name, value) in command.get_envs() {
            match value {
                Some(value) => setsid.env(name, value),
                None => setsid.env_remove(name),
            };
        }
        if let Some(folder) = command.get_current_dir() {
            setsid.current_dir(folder);
        }
        let child = setsid
            .stdin(terminal_handle())
            .stdout(terminal_handle())
            .stderr(terminal_handle())
            .spawn();
        let (output, is_closing) = (Arc::default(), Arc::default());
        let (shared_output, shared_is_closing) = (Arc::clone(&output), Arc::clone(&is_closing));
        Self {
            child: child.expect("setsid is installed"),
            reader: Some(std::thread::spawn(move || {
                collect_output(master, &shared_output, &shared_is_closing);
            })),
            output,
            is_closing,
        }
    }

    /// Process id of the command, which replaces `setsid`.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Raw output of the command in the terminal so far.
    pub fn output(&self) -> String {
        let output = self.output.lock().unwrap_or_else(PoisonError::into_inner);
        String::from_utf8_lossy(&output).into_owned()
    }

    /// Waits until the terminal shows `text`.
    ///
    /// # Panics
    /// If the text does not appear in time.
    pub fn wait_for(&self, text: &str) {
        wait_until(&format!("{text:?} in the terminal"), PATIENCE, || {
            self.output().contains(text).then_some(())
        });
    }

    /// Closes the terminal. [`Self::output`] keeps the output up to then; a second call has no effect.
    ///
    /// # Panics
    /// If the thread that reads the terminal has panicked.
    pub fn close(&mut self) {
        self.is_closing.store(true, Ordering::Release);
        // The terminal closes when its thread ends and drops the only handle.
        if let Some(reader) = self.reader.take() {
            reader.join().expect("the terminal can be read");
        }
    }

    /// Waits for the end of the command.
    ///
    /// # Panics
    /// If it does not end within `patience`.
    pub fn finish_within(&mut self, patience: Duration) -> ExitStatus {
        let deadline = now() + patience;
        loop {
            if let Some(status) = self.child.try_wait().expect("the child can be polled") {
                return status;
            }
            assert!(now() < deadline, "not ended within {patience:?}: {}", self.output());
            std::thread::sleep(POLL_INTERVAL);
        }
    }
}

impl Drop for PtyCommand {
    fn drop(&mut self) {
        let _ended = self.child.kill().is_err();
        let _reaped = self.child.wait().is_err();
        self.is_closing.store(true, Ordering::Release);
    }
}

/// Collects terminal output until `is_closing` is set. The terminal closes when this function returns.
fn collect_output(master: OwnedFd, output: &Mutex<Vec<u8>>, is_closing: &AtomicBool) {
    // A read that blocks would keep the terminal open after `close`.
    rustix::fs::fcntl_setfl(&master, OFlags::NONBLOCK).expect("the flag can be set");
    let (mut master, mut buffer) = (File::from(master), [0; 4096]);
    while !is_closing.load(Ordering::Acquire) {
        match master.read(&mut buffer) {
            Ok(n) => output
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .extend_from_slice(&buffer[..n]),
            // Nothing new, or the command has ended.
            Err(_) => std::thread::sleep(POLL_INTERVAL),
        }
    }
}
