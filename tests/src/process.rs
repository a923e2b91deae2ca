//! Runs the `reveille` command as users do, for `tests/program/`. Every wait here has a time limit and panics after it.
//! A process that a test starts is killed when the test drops it. Linux only: states of processes come from `/proc`.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use reveille_common::bus::{Bus, BusError};
use reveille_common::message::Query;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// Time limit for anything that should end without help. Generous: it only bounds the duration of a failing test.
pub const PATIENCE: Duration = Duration::from_mins(2);

/// CPU time after which a process counts as working, in ticks of `/proc` (hundredths of a second).
const WORKING_TICKS: u64 = 20;

/// Interval between two checks of a condition.
pub(super) const POLL_INTERVAL: Duration = Duration::from_millis(10);

/// Returns the program under test: the path in the variable `REVEILLE`, or else the binary next to the running test.
/// The tests that use it belong to the package of the command (`tests/program/`), so cargo has built it before they
/// run.
///
/// # Panics
/// If the program does not exist.
pub fn reveille() -> &'static Path {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| std::env::var_os("REVEILLE").map_or_else(next_to_test, PathBuf::from))
}

fn next_to_test() -> PathBuf {
    let test = std::env::current_exe().expect("a test has a path");
    let program = test
        .ancestors()
        .nth(2)
        .expect("tests are in target/PROFILE/deps")
        .join("reveille");
    assert!(
        program.exists(),
        "{}: file missing; build it with cargo test -p reveille-deploy",
        program.display()
    );
    program
}

/// Folder of one test; removed on drop unless the test fails. Commands that run in it do not see the runs of other
/// tests.
#[derive(Debug)]
pub struct TestFolder(PathBuf);

impl TestFolder {
    /// Creates a new folder with the empty subfolder `runtime`, in which commands register their runs.
    ///
    /// # Panics
    /// If the folder cannot be created.
    pub fn new() -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let name = format!("reveille-test-{}-{number}", std::process::id());
        let path = std::env::temp_dir().join(name);
        fs::create_dir_all(path.join("runtime")).expect("the folder for temporary files is writable");
        Self(path)
    }

    /// Path of the folder.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Returns the path of an entry in the folder.
    pub fn join(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// Writes a file in the folder and returns its path.
    ///
    /// # Panics
    /// If the file cannot be written.
    pub fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.join(name);
        fs::write(&path, text).expect("a test's folder is writable");
        path
    }

    /// Returns the command `reveille ARGS` with this folder as working directory. Arguments are separated by white
    /// space and not quoted; add an argument that contains a space with [`Command::arg`].
    pub fn command(&self, args: &str) -> Command {
        let mut command = Command::new(reveille());
        command
            .args(args.split_whitespace())
            .current_dir(&self.0)
            .env("XDG_RUNTIME_DIR", self.join("runtime"))
            // The tester's own setting would change the output on standard error.
            .env_remove("RUST_LOG");
        command
    }

    /// Starts `reveille ARGS` in this folder, as [`Self::command`] describes.
    ///
    /// # Panics
    /// If the program is missing or cannot be started.
    pub fn start(&self, args: &str) -> Process {
        Process::start(&mut self.command(args))
    }

    /// Runs `reveille ARGS` in this folder and waits for its end. It may fail.
    ///
    /// # Panics
    /// If the program cannot be started or does not end within [`PATIENCE`].
    pub fn run(&self, args: &str) -> FinishedProcess {
        self.start(args).finish()
    }

    /// Runs `reveille ARGS --json` in this folder and parses the printed summary.
    ///
    /// # Panics
    /// If the command fails.
    pub fn summary(&self, args: &str) -> SummaryJson {
        self.run(&format!("{args} --json")).summary()
    }

    /// Runs `reveille clock --run RUN COMMAND` and returns its standard output.
    ///
    /// # Panics
    /// If the command fails.
    pub fn clock(&self, run: &str, command: &str) -> String {
        let clock = self.run(&format!("clock --run {run} {command}"));
        assert!(clock.is_success(), "clock {command}: {clock}");
        clock.stdout
    }

    /// Waits until the devices of `run` have joined and its TTI is at least `tti`; returns the current TTI.
    ///
    /// # Panics
    /// If the run does not reach `tti` in time.
    pub fn wait_for_tti(&self, run: &str, tti: u64) -> u64 {
        wait_until(&format!("run {run} to pass TTI {tti}"), PATIENCE, || {
            let status = self.run(&format!("clock --run {run} status")).stdout;
            // Such as `running at TTI 9 of 60`, the text of `ClockStatus` in `common/src/message/control.rs`.
            let mut words = status.split_whitespace().skip_while(|&word| word != "TTI");
            // The status also shows TTI 0 before the devices have joined.
            let has_begun = !status.starts_with("joining");
            let current = words.nth(1)?.parse().ok();
            current.filter(|&current| has_begun && current >= tti)
        })
    }

    /// Waits until the clock of `run` answers, even before its devices have joined.
    ///
    /// # Panics
    /// If the clock does not answer in time.
    pub fn wait_for_clock(&self, run: &str) {
        wait_until(&format!("run {run} to have a clock"), PATIENCE, || {
            let status = self.run(&format!("clock --run {run} status"));
            status.is_success().then_some(())
        });
    }

    /// Starts `reveille bs` with the options of `SHORT_RUN` in `external_policy.rs` and `args`, and waits until device
    /// processes can join. The awaited text is a note of `deploy/src/commands/bs.rs`.
    ///
    /// # Panics
    /// If the base station does not wait for devices in time.
    pub fn start_waiting_bs(&self, run: &str, endpoint: &str, args: &str) -> Process {
        let bs = self.start(&format!("bs -n 30 -k 400 --run {run} --listen {endpoint} {args}"));
        bs.wait_for_stderr("waiting for 30 devices");
        bs
    }

    /// Reads the bytes of a file in the folder.
    ///
    /// # Panics
    /// If the file cannot be read.
    pub fn bytes(&self, name: &str) -> Vec<u8> {
        fs::read(self.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// Counts the finished runs in the journal of the sweep in subfolder `out`; 0 without a journal.
    pub fn count_finished_runs(&self, out: &str) -> usize {
        let text = fs::read_to_string(self.join(&format!("{out}/runs.journal"))).unwrap_or_default();
        // The first line names the sweep (`lab/src/sweep/journal/mod.rs`).
        text.matches('\n').count().saturating_sub(1)
    }

    /// Lists the entry names of a subfolder; empty if the subfolder does not exist.
    pub fn list(&self, name: &str) -> Vec<String> {
        let entries = fs::read_dir(self.join(name)).into_iter().flatten().flatten();
        let mut names: Vec<String> = entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }
}

impl Default for TestFolder {
    fn default() -> Self {
        Self::new()
    }
}

impl Drop for TestFolder {
    fn drop(&mut self) {
        // Keep the folder of a failed test for inspection.
        if !std::thread::panicking() {
            let _gone = fs::remove_dir_all(&self.0).is_err();
        }
    }
}

/// Output of a process so far.
#[derive(Clone, Default)]
struct Output {
    text: Arc<Mutex<Vec<u8>>>,
    is_closed: Arc<AtomicBool>,
}

impl Output {
    /// Collects all output of `source` on another thread.
    fn collect(mut source: impl Read + Send + 'static) -> Self {
        let output = Self::default();
        let shared = output.clone();
        // A full pipe would block the process under test.
        std::thread::spawn(move || {
            let mut buffer = [0; 4096];
            while let Ok(n @ 1..) = source.read(&mut buffer) {
                shared.lock().extend_from_slice(&buffer[..n]);
            }
            shared.is_closed.store(true, Ordering::Release);
        });
        output
    }

    /// Output up to now.
    fn so_far(&self) -> String {
        String::from_utf8_lossy(&self.lock()).into_owned()
    }

    /// Waits until all writers have closed the stream and returns everything. A child that outlives its parent holds it
    /// open.
    fn complete(&self) -> String {
        wait_until("the end of a process's output", PATIENCE, || {
            self.is_closed.load(Ordering::Acquire).then_some(())
        });
        self.so_far()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Vec<u8>> {
        self.text.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Running process, killed on drop.
pub struct Process {
    child: Child,
    stdout: Output,
    stderr: Output,
}

impl Process {
    /// Starts `command`.
    ///
    /// # Panics
    /// If the command cannot be started.
    pub fn start(command: &mut Command) -> Self {
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut child = command.spawn().expect("the program can be started");
        let stdout = Output::collect(child.stdout.take().expect("piped"));
        let stderr = Output::collect(child.stderr.take().expect("piped"));
        Self { child, stdout, stderr }
    }

    /// Process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal to the process.
    pub fn signal(&self, signal: Signal) {
        send_signal(self.pid(), signal);
    }

    /// Standard output so far.
    pub fn stdout(&self) -> String {
        self.stdout.so_far()
    }

    /// Standard error so far.
    pub fn stderr(&self) -> String {
        self.stderr.so_far()
    }

    /// Waits until standard error contains `text`.
    ///
    /// # Panics
    /// If the text does not appear in time.
    pub fn wait_for_stderr(&self, text: &str) {
        wait_until(&format!("{text:?} on standard error"), PATIENCE, || {
            self.stderr().contains(text).then_some(())
        });
    }

    /// Waits until the process has a SIGINT handler. Before that, the signal ends the process without a message.
    ///
    /// # Panics
    /// If the condition is not met in time.
    pub fn wait_for_handlers(&self) {
        wait_for_handler(self.pid(), Signal::INT);
    }

    /// Waits until the process has used 0.2 s of CPU time, which shows that it has started its work.
    ///
    /// # Panics
    /// If the condition is not met in time.
    pub fn wait_for_work(&self) {
        let ticks_before = self.cpu_ticks();
        wait_until("the process to work", PATIENCE, || {
            (self.cpu_ticks() >= ticks_before + WORKING_TICKS).then_some(())
        });
    }

    /// CPU time used by the process so far, in ticks as [`WORKING_TICKS`]; 0 after its end.
    fn cpu_ticks(&self) -> u64 {
        let line = fs::read_to_string(format!("/proc/{}/stat", self.pid())).unwrap_or_default();
        // The process name before these fields can contain spaces and parentheses.
        let fields = line.rsplit_once(')').map_or("", |(_, fields)| fields);
        // utime and stime, fields 14 and 15 of the whole line.
        let times = fields.split_whitespace().skip(11).take(2);
        times.filter_map(|ticks| ticks.parse::<u64>().ok()).sum()
    }

    /// Waits for the end of the process.
    ///
    /// # Panics
    /// If the process does not end in time.
    pub fn finish(self) -> FinishedProcess {
        self.finish_within(PATIENCE)
    }

    /// Waits at most `patience` for the end of the process.
    ///
    /// # Panics
    /// If the process does not end in time.
    pub fn finish_within(mut self, patience: Duration) -> FinishedProcess {
        let deadline = now() + patience;
        let status = loop {
            match self.child.try_wait().expect("the child can be polled") {
                Some(status) => break status,
                None if now() < deadline => std::thread::sleep(POLL_INTERVAL),
                None => panic!(
                    "process {} has not ended within {patience:?}; its standard error: {}",
                    self.pid(),
                    self.stderr()
                ),
            }
        };
        FinishedProcess {
            status,
            stdout: self.stdout.complete(),
            stderr: self.stderr.complete(),
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ended = self.child.kill().is_err();
        let _reaped = self.child.wait().is_err();
    }
}

/// Ended process.
#[derive(Debug)]
pub struct FinishedProcess {
    /// Exit status of the process.
    pub status: ExitStatus,
    /// Complete standard output.
    pub stdout: String,
    /// Complete standard error.
    pub stderr: String,
}

impl FinishedProcess {
    /// Exit code; `None` if a signal ended the process.
    pub fn code(&self) -> Option<i32> {
        self.status.code()
    }

    /// Whether the process succeeded.
    pub fn is_success(&self) -> bool {
        self.status.success()
    }

    /// Parses the summary that the process printed.
    ///
    /// # Panics
    /// If the process failed or printed no summary.
    pub fn summary(&self) -> SummaryJson {
        assert!(self.is_success(), "{self}");
        SummaryJson(serde_json::from_str(&self.stdout).expect("--json prints JSON"))
    }
}

impl std::fmt::Display for FinishedProcess {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{}\nstandard output: {}\nstandard error: {}",
            self.status, self.stdout, self.stderr
        )
    }
}

/// Checks that the process ended with this exit code and an error that contains all of `parts`. With exit code 1, which
/// is not a usage error, standard error must be one line that starts with `reveille: `.
///
/// # Panics
/// If the process ended in any other way.
pub fn assert_refused(finished: &FinishedProcess, code: i32, parts: &[&str]) {
    assert_eq!(finished.code(), Some(code), "{finished}");
    for part in parts {
        assert!(finished.stderr.contains(part), "no {part:?}: {finished}");
    }
    assert!(!finished.stderr.contains("panicked"), "{finished}");
    if code == 1 {
        assert!(finished.stderr.starts_with("reveille: "), "{finished}");
        assert_eq!(finished.stderr.trim().lines().count(), 1, "one paragraph: {finished}");
    }
}

/// Contents of a `summary.json`, also printed by `--json`. Its fields are defined in `deploy/src/summary.rs`.
#[derive(Clone, Debug)]
pub struct SummaryJson(Value);

impl SummaryJson {
    /// Reads the summary in a run folder.
    ///
    /// # Panics
    /// If the file is missing or is not JSON.
    pub fn read(folder: &Path) -> Self {
        let text = fs::read_to_string(folder.join("summary.json")).expect("the run folder has a summary");
        Self(serde_json::from_str(&text).expect("summary.json is JSON"))
    }

    /// Digest of the run.
    ///
    /// # Panics
    /// If the value is missing.
    pub fn digest(&self) -> &str {
        self.0["digest"].as_str().expect("a digest is text")
    }

    /// Status of the run: `complete` or `interrupted`.
    ///
    /// # Panics
    /// If the value is missing.
    pub fn status(&self) -> &str {
        self.0["status"].as_str().expect("a status is text")
    }

    /// Text at a path such as `audit`.
    ///
    /// # Panics
    /// If the value is missing.
    pub fn text(&self, path: &str) -> &str {
        let value = path.split('.').fold(&self.0, |value, name| &value[name]);
        value.as_str().unwrap_or_else(|| panic!("{path} is not text: {value}"))
    }

    /// Whole number at a path such as `timing.malformed_messages`.
    ///
    /// # Panics
    /// If the value is missing.
    pub fn number(&self, path: &str) -> u64 {
        let value = path.split('.').fold(&self.0, |value, name| &value[name]);
        value
            .as_u64()
            .unwrap_or_else(|| panic!("{path} is not a whole number: {value}"))
    }

    /// Value of the metric `name`.
    ///
    /// # Panics
    /// If the value is missing, or null because the metric is not defined in this run.
    pub fn metric(&self, name: &str) -> f64 {
        let value = &self.0["metrics"][name];
        value
            .as_f64()
            .unwrap_or_else(|| panic!("{name} is not a number: {value}"))
    }
}

/// Waits until the process `pid` has a handler of `signal`.
///
/// # Panics
/// If the condition is not met in time.
pub fn wait_for_handler(pid: u32, signal: Signal) {
    wait_until(&format!("the process to handle {signal:?}"), PATIENCE, || {
        let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
        let caught_hex = status.lines().find_map(|line| line.strip_prefix("SigCgt:"))?;
        let caught_signals = u64::from_str_radix(caught_hex.trim(), 16).ok()?;
        (caught_signals >> (signal.as_raw() - 1) & 1 == 1).then_some(())
    });
}

/// Waits until `poll` returns a value.
///
/// # Panics
/// If `poll` returns no value within `patience`; the panic message names the `condition`.
pub fn wait_until<T>(condition: &str, patience: Duration, mut poll: impl FnMut() -> Option<T>) -> T {
    let deadline = now() + patience;
    loop {
        if let Some(value) = poll() {
            return value;
        }
        assert!(now() < deadline, "waited {patience:?} for {condition}");
        std::thread::sleep(POLL_INTERVAL);
    }
}

/// Repeats a query to the base station behind `bus` until it answers: it listens shortly before it serves.
///
/// # Errors
/// The errors of [`Bus::query`].
///
/// # Panics
/// If the base station does not answer.
pub async fn ask<Q: Query<Address = ()>>(bus: &Bus, request: &Q) -> Result<Q::Reply, BusError> {
    let deadline = now() + PATIENCE;
    loop {
        if let Some(reply) = bus.query(request, PATIENCE).await? {
            return Ok(reply);
        }
        assert!(now() < deadline, "waited {PATIENCE:?} for an answer");
        tokio::time::sleep(POLL_INTERVAL).await;
    }
}

/// Returns the current time.
#[expect(clippy::disallowed_methods, reason = "tests give up after a while of real time")]
pub fn now() -> Instant {
    Instant::now()
}

/// Sends a signal to a process that may have ended.
pub fn send_signal(pid: u32, signal: Signal) {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
    let _gone = pid.is_some_and(|pid| kill_process(pid, signal).is_err());
}

/// Whether a process is alive. A zombie process is not.
pub fn is_alive(pid: u32) -> bool {
    fs::read(format!("/proc/{pid}/cmdline")).is_ok_and(|line| !line.is_empty())
}

/// Returns the ids of the live `reveille device` processes of a run, found by command line. Zombies are not included.
/// The run must be one argument, `--run=RUN`, as `deploy/src/child_process.rs` writes it.
pub fn hosts_of(run: &str) -> Vec<u32> {
    let processes = fs::read_dir("/proc").into_iter().flatten().flatten();
    let pids = processes.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    let mut host_pids: Vec<u32> = pids.filter(|&pid| is_host_of(pid, run)).collect();
    host_pids.sort_unstable();
    host_pids
}

fn is_host_of(pid: u32, run: &str) -> bool {
    let command_line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    let args: Vec<&[u8]> = command_line.split(|&byte| byte == 0).collect();
    args.get(1) == Some(&&b"device"[..]) && args.contains(&format!("--run={run}").as_bytes())
}

/// Returns a run name that starts with `name` and that no other test uses.
pub fn unique_run(name: &str) -> String {
    static NUMBER: AtomicU32 = AtomicU32::new(0);
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    format!("{name}-{}-{number}", std::process::id())
}

/// Returns a free endpoint on this machine. Its port lies below the range from which Linux by default serves
/// `127.0.0.1:0` and outgoing connections, so that no other process takes it before it is used.
///
/// # Panics
/// If every port of the range is in use.
pub fn free_endpoint() -> String {
    const PORTS: std::ops::Range<u16> = 12_000..32_000;
    static NUMBER: AtomicU32 = AtomicU32::new(0);
    // Test programs with consecutive process ids start 101 ports apart.
    let start = std::process::id().wrapping_mul(101);
    let port_count = PORTS.len() as u32;
    (0..port_count)
        .map(|_| start.wrapping_add(NUMBER.fetch_add(1, Ordering::Relaxed)) % port_count)
        .map(|offset| format!("127.0.0.1:{}", u32::from(PORTS.start) + offset))
        .find(|address| std::net::TcpListener::bind(address).is_ok())
        .map(|address| format!("tcp/{address}"))
        .expect("a free port")
}
