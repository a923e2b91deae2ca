//! Set-up of `tracing` for all processes: `main` of the program calls it once at its start, with the options `-v` and
//! `--log-format`. No result depends on it; `docs/command-line.md` describes the levels.

use std::io::IsTerminal;

use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer, Registry};

/// The format of log lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LogFormat {
    /// Text for human readers.
    #[default]
    Text,
    /// One JSON object per line.
    Json,
}

/// Sends log lines to `writer`, which must end at standard error: standard output carries results. Text has colours if
/// standard error is a terminal. `RUST_LOG` sets the filter. Without it `verbosity` does: 0 warnings, 1 information, 2
/// debugging, 3 and above everything, zenoh's own lines included. Without either, text does not name the modules.
/// `extra` sees events whatever the filter.
pub fn init<W, L>(verbosity: u8, format: LogFormat, writer: W, extra: Option<L>)
where
    W: for<'a> MakeWriter<'a> + Send + Sync + 'static,
    L: Layer<Registry> + Send + Sync,
{
    let default_filter = match verbosity {
        // zenoh logs every lost link as an error; the run reports lost links itself.
        0 => "warn,zenoh=off,zenoh_transport=off,zenoh_link_tcp=off",
        1 => "info,zenoh=warn",
        2 => "debug,zenoh=info",
        _ => "trace",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(default_filter));
    let lines = tracing_subscriber::fmt::layer().with_writer(writer);
    let lines = match format {
        LogFormat::Text => lines
            .with_ansi(std::io::stderr().is_terminal())
            .with_target(verbosity > 0 || std::env::var_os(EnvFilter::DEFAULT_ENV).is_some())
            .boxed(),
        LogFormat::Json => lines.json().boxed(),
    };
    let subscriber = tracing_subscriber::registry()
        .with(extra)
        .with(lines.with_filter(filter));
    // A second call, as in tests, keeps the first subscriber.
    let _already_set = subscriber.try_init().is_err();
}
