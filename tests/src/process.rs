//! Running the `reveille` command as its users do, so that no test can hang and no process outlives its test.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use reveille_common::bus::{Bus, BusError};
use reveille_common::message::Question;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// How long anything that should end by itself may take. Generous: it only bounds how long a broken test lasts.
pub const PATIENCE: Duration = Duration::from_mins(2);

/// How long to wait between two looks at a condition.
const LOOK: Duration = Duration::from_millis(10);

/// The program under test: the one that the variable `REVEILLE` names, or else the one beside the running test. The
/// tests that use it belong to the package of the command (`tests/program/`), so cargo has built it before they run.
///
/// # Panics
/// If it is not there.
pub fn reveille() -> &'static Path {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| std::env::var_os("REVEILLE").map_or_else(beside_the_test, PathBuf::from))
}

fn beside_the_test() -> PathBuf {
    let test = std::env::current_exe().expect("a test has a path");
    let program = test
        .ancestors()
        .nth(2)
        .expect("tests lie in target/PROFILE/deps")
        .join("reveille");
    assert!(
        program.exists(),
        "{} is not there: cargo test -p reveille-deploy builds it",
        program.display()
    );
    program
}

/// A folder of one test, gone with it. What runs in it finds no other test's runs.
#[derive(Debug)]
pub struct Folder(PathBuf);

impl Folder {
    /// A new, empty folder.
    ///
    /// # Panics
    /// If it cannot be made.
    pub fn new() -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let name = format!("reveille-test-{}-{number}", std::process::id());
        let path = std::env::temp_dir().join(name);
        fs::create_dir_all(path.join("runtime")).expect("the folder for temporary files is writable");
        Self(path)
    }

    /// The path of the folder.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The path of something in it.
    pub fn join(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// Writes a file in it.
    ///
    /// # Panics
    /// If it cannot.
    pub fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.join(name);
        fs::write(&path, text).expect("a test's folder is writable");
        path
    }

    /// The command `reveille ARGS`, to be run in this folder.
    pub fn command(&self, args: &str) -> Command {
        let mut command = Command::new(reveille());
        command
            .args(args.split_whitespace())
            .current_dir(&self.0)
            .env("XDG_RUNTIME_DIR", self.join("runtime"))
            .env_remove("RUST_LOG");
        command
    }

    /// Starts `reveille ARGS` in this folder. Arguments are separated by spaces.
    pub fn start(&self, args: &str) -> Process {
        Process::start(&mut self.command(args))
    }

    /// Runs `reveille ARGS` in this folder to its end.
    pub fn run(&self, args: &str) -> Finished {
        self.start(args).finish()
    }

    /// Runs `reveille ARGS --json` in this folder and reads what it prints.
    ///
    /// # Panics
    /// If it fails.
    pub fn summary(&self, args: &str) -> Summary {
        self.run(&format!("{args} --json")).summary()
    }

    /// Sends a command to the clock of `run`, and gives the answer.
    ///
    /// # Panics
    /// If nobody obeys.
    pub fn clock(&self, run: &str, action: &str) -> String {
        let said = self.run(&format!("clock --run {run} {action}"));
        assert!(said.is_success(), "clock {action}: {said}");
        said.stdout
    }

    /// Waits until the devices of `run` have joined and it is past `tti`, and gives the TTI that it is at.
    ///
    /// # Panics
    /// If it does not get there.
    pub fn wait_for_tti(&self, run: &str, tti: u64) -> u64 {
        wait_until(&format!("run {run} to pass TTI {tti}"), PATIENCE, || {
            let said = self.run(&format!("clock --run {run} status")).stdout;
            let words: Vec<&str> = said.split_whitespace().collect();
            let at = words.iter().position(|&word| word == "TTI")? + 1;
            let has_begun = !said.contains("waiting for devices to join");
            words.get(at)?.parse().ok().filter(|&now| has_begun && now >= tti)
        })
    }

    /// Waits until the clock of `run` answers, whether or not its devices have joined.
    ///
    /// # Panics
    /// If it does not.
    pub fn wait_for_clock(&self, run: &str) {
        wait_until(&format!("run {run} to have a clock"), PATIENCE, || {
            let status = self.run(&format!("clock --run {run} status"));
            status.is_success().then_some(())
        });
    }

    /// Starts a base station that waits for thirty devices.
    pub fn waiting_bs(&self, run: &str, endpoint: &str, args: &str) -> Process {
        let bs = self.start(&format!("bs -n 30 -k 400 --run {run} --listen {endpoint} {args}"));
        bs.wait_for_stderr("waiting for 30 devices");
        bs
    }

    /// The bytes of a file in it.
    ///
    /// # Panics
    /// If it cannot be read.
    pub fn bytes(&self, name: &str) -> Vec<u8> {
        fs::read(self.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// Finished runs in the journal of the sweep in the folder `out` within this one.
    pub fn journal_lines(&self, out: &str) -> usize {
        let text = fs::read_to_string(self.join(&format!("{out}/runs.journal"))).unwrap_or_default();
        text.matches('\n').count().saturating_sub(1)
    }

    /// The names of what is in a folder within this one; none if it is not there.
    pub fn list(&self, name: &str) -> Vec<String> {
        let entries = fs::read_dir(self.join(name)).into_iter().flatten().flatten();
        let mut names: Vec<String> = entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }
}

impl Default for Folder {
    fn default() -> Self {
        Self::new()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // Kept for a look after a failure.
        if !std::thread::panicking() {
            let _gone = fs::remove_dir_all(&self.0).is_err();
        }
    }
}

/// What a process has written so far.
#[derive(Clone, Default)]
struct Output {
    text: Arc<Mutex<Vec<u8>>>,
    is_closed: Arc<AtomicBool>,
}

impl Output {
    /// Gathers all that comes from `source`.
    fn gather(mut source: impl Read + Send + 'static) -> Self {
        let output = Self::default();
        let filled = output.clone();
        std::thread::spawn(move || {
            let mut part = [0; 4096];
            while let Ok(n @ 1..) = source.read(&mut part) {
                filled.lock().extend_from_slice(&part[..n]);
            }
            filled.is_closed.store(true, Ordering::Release);
        });
        output
    }

    fn so_far(&self) -> String {
        String::from_utf8_lossy(&self.lock()).into_owned()
    }

    /// Everything, once all writers have closed it: a child that outlives its parent holds it open.
    fn all(&self) -> String {
        wait_until("the end of a process's output", PATIENCE, || {
            self.is_closed.load(Ordering::Acquire).then_some(())
        });
        self.so_far()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Vec<u8>> {
        self.text.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A running process, killed when dropped.
pub struct Process {
    child: Child,
    stdout: Output,
    stderr: Output,
}

impl Process {
    /// Starts `command`.
    ///
    /// # Panics
    /// If it cannot.
    pub fn start(command: &mut Command) -> Self {
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut child = command.spawn().expect("the program can be started");
        let stdout = Output::gather(child.stdout.take().expect("piped"));
        let stderr = Output::gather(child.stderr.take().expect("piped"));
        Self { child, stdout, stderr }
    }

    /// Its process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Sends it a signal.
    pub fn signal(&self, signal: Signal) {
        send_signal(self.pid(), signal);
    }

    /// What it has written to standard output so far.
    pub fn stdout(&self) -> String {
        self.stdout.so_far()
    }

    /// What it has written to standard error so far.
    pub fn stderr(&self) -> String {
        self.stderr.so_far()
    }

    /// Waits until it has written `text` to standard error.
    ///
    /// # Panics
    /// If it does not.
    pub fn wait_for_stderr(&self, text: &str) {
        wait_until(&format!("{text:?} on standard error"), PATIENCE, || {
            self.stderr().contains(text).then_some(())
        });
    }

    /// Waits until it takes SIGINT itself: before its handler is in place the signal ends it as well, but without a
    /// word.
    ///
    /// # Panics
    /// If that does not come in time.
    pub fn wait_for_handlers(&self) {
        wait_until("the process to take a signal", PATIENCE, || {
            let status = fs::read_to_string(format!("/proc/{}/status", self.pid())).ok()?;
            let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"))?;
            let caught = u64::from_str_radix(caught.trim(), 16).ok()?;
            let bit = Signal::INT.as_raw() - 1;
            (caught >> bit & 1 == 1).then_some(())
        });
    }

    /// Waits for its end.
    ///
    /// # Panics
    /// If it does not end in time.
    pub fn finish(self) -> Finished {
        self.finish_within(PATIENCE)
    }

    /// Waits for its end for at most `patience`.
    ///
    /// # Panics
    /// If it does not end in time.
    pub fn finish_within(mut self, patience: Duration) -> Finished {
        let deadline = now() + patience;
        let status = loop {
            match self.child.try_wait().expect("a child can be waited for") {
                Some(status) => break status,
                None if now() < deadline => std::thread::sleep(LOOK),
                None => panic!(
                    "process {} has not ended within {patience:?}; its standard error: {}",
                    self.pid(),
                    self.stderr()
                ),
            }
        };
        Finished {
            status,
            stdout: self.stdout.all(),
            stderr: self.stderr.all(),
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ended = self.child.kill().is_err();
        let _reaped = self.child.wait().is_err();
    }
}

/// A process that has ended.
#[derive(Debug)]
pub struct Finished {
    /// How the process ended.
    pub status: ExitStatus,
    /// All of its standard output.
    pub stdout: String,
    /// All of its standard error.
    pub stderr: String,
}

impl Finished {
    /// Its exit code, `None` if a signal ended it.
    pub fn code(&self) -> Option<i32> {
        self.status.code()
    }

    /// Whether it ended well.
    pub fn is_success(&self) -> bool {
        self.status.success()
    }

    /// The summary that it has printed.
    ///
    /// # Panics
    /// If it has not.
    pub fn summary(&self) -> Summary {
        assert!(self.is_success(), "{self}");
        Summary(serde_json::from_str(&self.stdout).expect("--json prints JSON"))
    }
}

impl std::fmt::Display for Finished {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{}\nstandard output: {}\nstandard error: {}",
            self.status, self.stdout, self.stderr
        )
    }
}

/// Checks a refusal: its exit code, one paragraph with all of `parts`.
///
/// # Panics
/// If it is another end.
pub fn assert_refused(end: &Finished, code: i32, parts: &[&str]) {
    assert_eq!(end.code(), Some(code), "{end}");
    for part in parts {
        assert!(end.stderr.contains(part), "no {part:?}: {end}");
    }
    assert!(!end.stderr.contains("panicked"), "{end}");
    if code == 1 {
        assert!(end.stderr.starts_with("reveille: "), "{end}");
        assert_eq!(end.stderr.trim().lines().count(), 1, "one paragraph: {end}");
    }
}

/// A `summary.json`.
#[derive(Clone, Debug)]
pub struct Summary(Value);

impl Summary {
    /// Reads the summary in a run folder.
    ///
    /// # Panics
    /// If there is none.
    pub fn read(folder: &Path) -> Self {
        let text = fs::read_to_string(folder.join("summary.json")).expect("the run folder has a summary");
        Self(serde_json::from_str(&text).expect("summary.json is JSON"))
    }

    /// The run's fingerprint.
    ///
    /// # Panics
    /// If there is none.
    pub fn digest(&self) -> &str {
        self.0["digest"].as_str().expect("a digest is text")
    }

    /// `complete` or `interrupted`.
    ///
    /// # Panics
    /// If there is none.
    pub fn status(&self) -> &str {
        self.0["status"].as_str().expect("a status is text")
    }

    /// The text at a path such as `audit`.
    ///
    /// # Panics
    /// If there is none.
    pub fn text(&self, path: &str) -> &str {
        let value = path.split('.').fold(&self.0, |value, name| &value[name]);
        value.as_str().unwrap_or_else(|| panic!("{path} is no text: {value}"))
    }

    /// The whole number at a path such as `timing.malformed`.
    ///
    /// # Panics
    /// If there is none.
    pub fn number(&self, path: &str) -> u64 {
        let value = path.split('.').fold(&self.0, |value, name| &value[name]);
        value
            .as_u64()
            .unwrap_or_else(|| panic!("{path} is no whole number: {value}"))
    }

    /// The metric `name`.
    ///
    /// # Panics
    /// If there is none.
    pub fn metric(&self, name: &str) -> f64 {
        let value = &self.0["metrics"][name];
        value.as_f64().unwrap_or_else(|| panic!("{name} is no number: {value}"))
    }
}

/// Waits until `look` sees something.
///
/// # Panics
/// If it does not within `patience`; `what` says what was waited for.
pub fn wait_until<T>(what: &str, patience: Duration, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = now() + patience;
    loop {
        if let Some(seen) = look() {
            return seen;
        }
        assert!(now() < deadline, "waited {patience:?} for {what}");
        std::thread::sleep(LOOK);
    }
}

/// Asks the base station behind `bus` until it answers: it listens a moment before it serves.
///
/// # Errors
/// As [`Bus::ask`].
///
/// # Panics
/// If it does not answer.
pub async fn ask<Q: Question<Address = ()>>(bus: &Bus, request: &Q) -> Result<Q::Reply, BusError> {
    let deadline = now() + PATIENCE;
    loop {
        if let Some(reply) = bus.ask(request, PATIENCE).await? {
            return Ok(reply);
        }
        assert!(now() < deadline, "waited {PATIENCE:?} for an answer");
        tokio::time::sleep(LOOK).await;
    }
}

/// The moment.
#[expect(clippy::disallowed_methods, reason = "tests give up after a while of real time")]
pub fn now() -> Instant {
    Instant::now()
}

/// Sends a signal to a process that may have gone.
pub fn send_signal(pid: u32, signal: Signal) {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
    let _gone = pid.is_some_and(|pid| kill_process(pid, signal).is_err());
}

/// Whether a process lives. One that has ended and was not waited for does not.
pub fn lives(pid: u32) -> bool {
    fs::read(format!("/proc/{pid}/cmdline")).is_ok_and(|line| !line.is_empty())
}

/// The living `reveille device` processes of a run, by their command lines. Those that have ended and were not waited
/// for have none.
pub fn hosts_of(run: &str) -> Vec<u32> {
    let processes = fs::read_dir("/proc").into_iter().flatten().flatten();
    let pids = processes.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    let mut hosts: Vec<u32> = pids.filter(|&pid| carries(pid, run)).collect();
    hosts.sort_unstable();
    hosts
}

fn carries(pid: u32, run: &str) -> bool {
    let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    let args: Vec<&[u8]> = line.split(|&byte| byte == 0).collect();
    args.get(1) == Some(&&b"device"[..]) && args.contains(&format!("--run={run}").as_bytes())
}

/// A run name that no other test uses.
pub fn unique_run(name: &str) -> String {
    static NUMBER: AtomicU32 = AtomicU32::new(0);
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    format!("{name}-{}-{number}", std::process::id())
}

/// An endpoint on this machine that was free a moment ago.
///
/// # Panics
/// If there is none.
pub fn free_endpoint() -> String {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("there is a free port");
    format!("tcp/{}", listener.local_addr().expect("a bound socket has an address"))
}
