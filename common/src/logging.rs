//! Set-up of `tracing` for all processes: `main` of the program calls it once at its start, with the options `-v` and
//! `--log-format`. No result depends on it; `docs/command-line.md` describes the levels.

use std::io::IsTerminal;

use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::MakeWriter;

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
/// debugging, 3 and above everything, zenoh's own lines included.
pub fn init<W>(verbosity: u8, format: LogFormat, writer: W)
where
    W: for<'a> MakeWriter<'a> + Send + Sync + 'static,
{
    let default_filter = match verbosity {
        // zenoh logs every lost link as an error; the run reports lost links itself.
        0 => "warn,zenoh=off,zenoh_transport=off,zenoh_link_tcp=off",
        1 => "info,zenoh=warn",
        2 => "debug,zenoh=info",
        _ => "trace",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(default_filter));
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(writer);
    // A second call, as in tests, keeps the first subscriber.
    let _already_set = match format {
        LogFormat::Text => builder.with_ansi(std::io::stderr().is_terminal()).try_init().is_err(),
        LogFormat::Json => builder.json().try_init().is_err(),
    };
}
