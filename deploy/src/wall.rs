//! What the command line takes from the machine: the time, threads that wait for a session, and the middle of what was
//! measured.

/// The time, to tell how long something took.
#[expect(clippy::disallowed_methods, reason = "the command line reports how long things took")]
pub fn now() -> std::time::Instant {
    std::time::Instant::now()
}

/// A runtime of `workers` threads. zenoh needs a multi-thread one, even with one worker.
///
/// # Errors
/// If the threads cannot be started.
pub fn runtime(workers: usize) -> std::io::Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(workers)
        .enable_all()
        .build()
}

/// The middle of `values`, NaN without any.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    match n {
        0 => f64::NAN,
        _ if n % 2 == 1 => values[n / 2],
        _ => f64::midpoint(values[n / 2 - 1], values[n / 2]),
    }
}
