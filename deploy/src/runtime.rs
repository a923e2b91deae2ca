//! Machine services for the command line: the time, tokio runtimes for bus sessions, and the median of measurements.
//! The time read here is only for reports and timeouts; it must never reach a run's results.

/// Worker threads of a command that serves a run or the dashboard.
pub(crate) const SERVER_WORKERS: usize = 2;
/// Worker threads of any other command with a runtime.
pub(crate) const CLIENT_WORKERS: usize = 1;

/// The current time, for durations.
#[expect(clippy::disallowed_methods, reason = "the command line reports how long things took")]
pub(crate) fn now() -> std::time::Instant {
    std::time::Instant::now()
}

/// Creates a runtime of `workers` threads. zenoh needs a multi-thread one, even with one worker.
///
/// # Errors
/// If the threads cannot be started.
pub(crate) fn runtime(workers: usize) -> std::io::Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(workers)
        .enable_all()
        .build()
}

/// Runs `command` to its end on a runtime of `workers` threads. Other tasks do not delay the return.
///
/// # Errors
/// If the command fails, or the threads cannot be started.
pub(crate) fn drive<T>(workers: usize, command: impl Future<Output = anyhow::Result<T>>) -> anyhow::Result<T> {
    let runtime = runtime(workers)?;
    let result = runtime.block_on(command);
    // A drop would wait for blocking tasks, such as a search through a long run for the dashboard.
    runtime.shutdown_background();
    result
}

/// The median of `values`; NaN if empty.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    match n {
        0 => f64::NAN,
        _ if n % 2 == 1 => values[n / 2],
        _ => f64::midpoint(values[n / 2 - 1], values[n / 2]),
    }
}
