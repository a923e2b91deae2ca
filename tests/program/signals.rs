//! SIGINT or SIGTERM at drawn moments of the long-running commands, with all cores busy: the command ends with its
//! documented code and leaves no process, registry entry or file RUNNING. `interrupt.rs` tests preparations with chosen
//! moments. A new long-running command needs a [`Case`].
//!
//! `.ci/run` selects the tests behind cargo features by the words `tun` and `transformer` in their names.

use std::collections::BTreeMap;
use std::fs;
use std::hint::spin_loop;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use reveille_common::rng::{Purpose, Stream};
use reveille_tests::process::{FinishedProcess, PATIENCE, Process, TestFolder, free_endpoint, unique_run, wait_until};
use rustix::process::Signal;

/// Number of signals sent to each command, each to a new process.
const SIGNALS_PER_COMMAND: usize = 50;
/// Latest time of a signal after the start. Half of the signals come in the first quarter.
const MAX_DELAY: Duration = Duration::from_millis(1500);
/// Processes under test in parallel.
const WORKERS: usize = 12;
/// Threads that keep the cores busy during the test.
const SPINNING_THREADS: usize = 3;
/// Environment variable that marks a process under test and its children.
const MARK_VARIABLE: &str = "REVEILLE_TEST_MARK";
/// Options of a run over the bus that takes an hour.
const LONG: &str = "-n 6 -k 1000000 --pace 4ms";
/// Options of a search before a run that takes hours; `interrupt.rs` repeats them.
const SEARCH: &str = "-p adjusted -n 200 --set policy.adjusted.pilot_ttis=900000000";
/// Output that a command prints after it has installed its handlers. If the program prints another text, the check of
/// these texts is vacuous.
const HANDLERS_INSTALLED: [&str; 3] = ["waiting for ", "connected to run", "dashboard at"];

/// Expected exit of a command after a signal, once its handlers are installed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ending {
    /// Exit code 130.
    Interrupted,
    /// Exit code 0, since the command shows output until it is interrupted; 130 while it has nothing to show.
    Shown,
    /// Default action of the signal, since the command needs no cleanup; or the command has already ended.
    ByDefault,
}
use Ending::{ByDefault, Interrupted, Shown};

/// Command under test.
struct Case {
    /// Arguments, in which OUT becomes a name that no other process uses. A command with `--resume` continues a copy of
    /// the run folder `resumed`, which the test has to prepare.
    args: String,
    expected: Ending,
}

impl Case {
    fn new(args: impl Into<String>, expected: Ending) -> Self {
        Self {
            args: args.into(),
            expected,
        }
    }
}

/// Whether this process, and thus every process under test, was started to ignore SIGINT, like background jobs of a
/// shell. Such a process has no default action before it installs its handlers.
fn ignores_interrupts() -> bool {
    let status = fs::read_to_string("/proc/self/status").expect("a status");
    let ignored_hex = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let ignored_signals = u64::from_str_radix(ignored_hex.expect("a mask").trim(), 16).expect("hexadecimal");
    ignored_signals >> (Signal::INT.as_raw() - 1) & 1 == 1
}

/// Sends [`SIGNALS_PER_COMMAND`] signals to each of the `cases`, and prints how often each command ended in which way.
fn check_signals(folder: &TestFolder, cases: &[Case]) {
    let (is_over, next_number) = (AtomicBool::new(false), AtomicUsize::new(0));
    let (is_over, next_number) = (&is_over, &next_number);
    let can_interrupt = !ignores_interrupts();
    let statuses = Mutex::new(BTreeMap::<(&str, String), usize>::new());
    thread::scope(|scope| {
        for _ in 0..SPINNING_THREADS {
            scope.spawn(|| {
                while !is_over.load(Ordering::Relaxed) {
                    spin_loop();
                }
            });
        }
        let work = || {
            while let number = next_number.fetch_add(1, Ordering::Relaxed)
                && number < SIGNALS_PER_COMMAND * cases.len()
            {
                let (round, case) = (number / cases.len(), &cases[number % cases.len()]);
                let signal = if can_interrupt && round % 2 == 0 {
                    Signal::INT
                } else {
                    Signal::TERM
                };
                let status = check_signal(folder, case, number, signal);
                let mut statuses = statuses.lock().unwrap_or_else(PoisonError::into_inner);
                *statuses.entry((&case.args, status)).or_default() += 1;
            }
        };
        let workers: Vec<_> = (0..WORKERS).map(|_| scope.spawn(work)).collect();
        let results: Vec<_> = workers.into_iter().map(thread::ScopedJoinHandle::join).collect();
        is_over.store(true, Ordering::Relaxed);
        assert!(results.iter().all(Result::is_ok), "a command failed, as printed above");
    });
    for ((args, status), count) in statuses.into_inner().unwrap_or_else(PoisonError::into_inner) {
        println!("{count:>3} {status}: {args}");
    }
}

/// Starts process `number` for `case`, sends it `signal` at a drawn moment, checks its end and returns its status.
fn check_signal(folder: &TestFolder, case: &Case, number: usize, signal: Signal) -> String {
    // An arbitrary seed, so that every execution draws the same moments.
    let mut stream = Stream::new(28, Purpose::Training, number as u64);
    let delay = MAX_DELAY.mul_f64(stream.unit().powi(2));
    let out = format!("out{number}");
    let is_resumed = case.args.contains("--resume");
    if is_resumed {
        copy_folder(folder, "resumed", &out);
        // Two copies at a time must not listen at the same port.
        fs::remove_file(folder.join(&format!("{out}/address.json"))).expect("removed");
    }
    let mut command = folder.command(&case.args.replace("OUT", &out));
    let mark = folder.join(&out);
    let process = Process::start(command.env(MARK_VARIABLE, &mark));
    let pid = process.pid();
    thread::sleep(delay);
    process.signal(signal);
    let finished = process.finish();
    let context = format!("{}: {signal:?} after {delay:?}: {finished}", case.args);
    let remaining_files: Vec<String> = folder
        .list(".")
        .into_iter()
        .filter(|name| belongs_to(name, &out))
        .collect();
    match (case.expected, finished.code()) {
        (Interrupted, Some(130)) | (Shown, Some(0 | 130)) | (ByDefault, Some(0)) => {}
        (Interrupted | Shown | ByDefault, None) => {
            assert_eq!(finished.status.signal(), Some(signal.as_raw()), "{context}");
            if case.expected != ByDefault {
                assert!(
                    remaining_files.is_empty() || is_resumed,
                    "files {remaining_files:?} remain: {context}"
                );
                assert!(
                    !HANDLERS_INSTALLED.iter().any(|text| finished.stderr.contains(text)),
                    "{context}"
                );
            }
        }
        (Interrupted | Shown | ByDefault, Some(_)) => panic!("{context}"),
    }
    let files = folder.list(&out);
    assert!(
        finished.code().is_none() || !files.iter().any(|file| file == "RUNNING"),
        "files {files:?}: {context}"
    );
    let registered = folder.list("runtime/reveille");
    let entry = format!("-{pid}.json");
    assert!(
        !registered.iter().any(|name| name.ends_with(&entry)),
        "registry {registered:?}: {context}"
    );
    wait_until(&format!("the end of all its processes: {context}"), PATIENCE, || {
        marked_processes(&mark).is_empty().then_some(())
    });
    finished.status.to_string()
}

/// Whether the file or folder `name` belongs to the process with this `out`.
fn belongs_to(name: &str, out: &str) -> bool {
    name.strip_prefix(out)
        .is_some_and(|suffix| suffix.is_empty() || suffix.starts_with('.'))
}

/// Returns the live processes that carry `mark`.
fn marked_processes(mark: &Path) -> Vec<String> {
    let mark = format!("{MARK_VARIABLE}={}", mark.display());
    let processes = fs::read_dir("/proc").into_iter().flatten().flatten();
    let is_marked = |path: &Path| {
        let environment = fs::read(path.join("environ")).unwrap_or_default();
        environment
            .split(|byte| *byte == 0)
            .any(|variable| variable == mark.as_bytes())
    };
    let marked = processes.filter(|process| is_marked(&process.path()));
    marked
        .map(|process| process.file_name().to_string_lossy().into_owned())
        .collect()
}

/// Copies a folder that holds files only, within `folder`.
fn copy_folder(folder: &TestFolder, from: &str, to: &str) {
    fs::create_dir(folder.join(to)).expect("a new folder");
    for name in folder.list(from) {
        let path = format!("{from}/{name}");
        fs::copy(folder.join(&path), folder.join(&format!("{to}/{name}"))).expect("copied");
    }
}

/// Runs `reveille ARGS` to its end; the tested commands read the files that it writes.
fn prepare(folder: &TestFolder, args: &str) {
    let finished: FinishedProcess = folder.run(args);
    assert!(finished.is_success(), "{args}: {finished}");
}

#[test]
fn signals_end_commands_that_make_runs() {
    let folder = TestFolder::new();
    folder.write("idle", "#!/bin/sh\nsleep 1000\n");
    fs::set_permissions(folder.join("idle"), fs::Permissions::from_mode(0o700)).expect("ours");
    let killed = folder.start("up -P 1 -n 50 -k 90000000 --window 100000 --quiet --out resumed --run resumed");
    folder.wait_for_tti("resumed", 20_000);
    killed.signal(Signal::KILL);
    killed.finish();
    let bs = format!("bs {LONG} --listen tcp/127.0.0.1:0 --run OUT --out OUT");
    let external = "-p external --policy-command ./idle";
    let q_learning = "train q-learning --devices 8 --episode-ttis 2000 --out OUT.json";
    let record = format!("train record {SEARCH} -k 1000 --seeds 2 --chunk 12 --stride 40 --out OUT.parquet");
    let cases = [
        Case::new(format!("up -P 2 {LONG} --out OUT"), Interrupted),
        Case::new(format!("up -P 0 {LONG} --out OUT --dashboard 127.0.0.1:0"), Interrupted),
        Case::new(format!("up -P 1 {LONG} --out OUT {external}"), Interrupted),
        Case::new(format!("up -P 2 {SEARCH} --out OUT"), Interrupted),
        Case::new("up -P 1 --resume OUT --run OUT", Interrupted),
        Case::new(bs, Interrupted),
        Case::new("run -n 10 -k 1000000000 --record OUT.mcap --out OUT", Interrupted),
        Case::new(format!("run {SEARCH} --out OUT"), Interrupted),
        Case::new(
            "sweep -p knn,adjusted -n 200 -k 1000 --seeds 2 --out OUT --set policy.adjusted.pilot_ttis=900000000",
            Interrupted,
        ),
        Case::new(q_learning, Interrupted),
        Case::new(record, Interrupted),
        Case::new("bench bus --processes 2 --time 1s", ByDefault),
        Case::new("bench scale -n 20 -k 100000", ByDefault),
        Case::new("bench study --policies random --seeds 1000", ByDefault),
    ];
    check_signals(&folder, &cases);
}

#[test]
fn signals_end_commands_that_join_or_show_runs() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("shown"), free_endpoint());
    prepare(
        &folder,
        "run -p knn -n 20 -k 3000 --record seen.mcap --quiet --out seen",
    );
    prepare(
        &folder,
        "sweep -p knn,random -n 10,20 -k 300 --seeds 2 --quiet --out table",
    );
    let bs = folder.start(&format!(
        "bs {LONG} --on-loss wait --quiet --out live --run {run} --listen {endpoint}"
    ));
    let join = format!("device --connect {endpoint} --run {run} --count 6");
    let device = folder.start(&join);
    folder.wait_for_tti(&run, 10);
    let nowhere = free_endpoint();
    let cases = [
        Case::new(
            format!("device --connect {nowhere} --run {run} --connect-timeout 1000s"),
            Interrupted,
        ),
        Case::new(join, Interrupted),
        Case::new(format!("dashboard --run {run} --listen 127.0.0.1:0"), Shown),
        Case::new("dashboard seen.mcap --listen 127.0.0.1:0", Shown),
        Case::new(format!("inspect tail --run {run}"), Shown),
        Case::new(format!("inspect stats --run {run}"), Shown),
        Case::new(format!("inspect record --run {run} OUT.mcap"), Shown),
        Case::new(format!("clock --run {run} run-to 900000 --wait"), ByDefault),
        Case::new("inspect tail seen.mcap", ByDefault),
        Case::new("inspect stats seen.mcap", ByDefault),
        Case::new("inspect verify seen.mcap", ByDefault),
        Case::new("compare --exit-code seen.mcap seen.mcap", ByDefault),
        Case::new("inspect export seen.mcap --to pcapng --out OUT.pcapng", ByDefault),
        Case::new("figures table --out OUT", ByDefault),
        Case::new("report table --out OUT", ByDefault),
        Case::new("analyse harvest --seeds 2", ByDefault),
    ];
    check_signals(&folder, &cases);
    bs.signal(Signal::TERM);
    assert_eq!(bs.finish().code(), Some(130));
    device.finish();
}

#[cfg(feature = "tune")]
#[test]
fn signals_end_a_tuning() {
    let folder = TestFolder::new();
    let tune = "tune -n 8 --design 3 --episodes 100 --episode-ttis 1000 --seeds 2 --ttis 1000 --out OUT.csv";
    check_signals(&folder, &[Case::new(tune, Interrupted)]);
}

#[cfg(feature = "train-dt")]
#[test]
fn signals_end_a_training_of_the_transformer() {
    let folder = TestFolder::new();
    // `RECORD` and `TRAIN` of `dt.rs`, with a longer training.
    let record = "train record -p age-index,knn -n 12 -k 400 --seeds 6 --set events.process=bursts";
    prepare(&folder, &format!("{record} --chunk 12 --stride 40 --out a.parquet"));
    let train = "train dt a.parquet --steps 100000 --batch 600 --patience 1000 --set policy.dt.width=8 \
                 --set policy.dt.heads=1 --set policy.dt.memory=3 --out OUT.safetensors";
    check_signals(&folder, &[Case::new(train, Interrupted)]);
}
