//! The fields of a run as a whole, and the presets.

use crate::declare::{Alternative, BELOW_ONE, POSITIVE, Preset, Sink, Value, number, registered, whole, word};
use crate::ids::{MAX_DEVICES, MAX_TTIS};

/// The presets. The first is what a file starts from unless it names another: the declared defaults.
pub const PRESETS: &[Preset] = &[
    Preset {
        name: "paper",
        about: "Table II, with the calibration that came closest to the paper's figures",
        text: include_str!("presets/paper.toml"),
    },
    Preset {
        name: "paper-literal",
        about: "the paper's words taken literally: uniform layout, detection by p(d), events of one TTI",
        text: include_str!("presets/paper-literal.toml"),
    },
    Preset {
        name: "quick",
        about: "20 devices and 1000 TTIs of `paper`: a first look within seconds",
        text: include_str!("presets/quick.toml"),
    },
];

/// The presets as words of the field `preset`.
const WORDS: [Alternative; PRESETS.len()] = {
    let mut words = [Alternative { name: "", about: "" }; PRESETS.len()];
    let mut at = 0;
    while at < words.len() {
        words[at] = Alternative {
            name: PRESETS[at].name,
            about: PRESETS[at].about,
        };
        at += 1;
    }
    words
};

crate::declare! {
    /// The run as a whole.
    #[derive(Clone, Debug)]
    pub(super) struct Run in "" {
        /// The set of values that all others are laid over.
        pub(super) preset: Option<String> = word(&WORDS, "paper"),
        /// Number of devices N.
        pub(super) devices: u32 = whole(1, MAX_DEVICES as u64, 50).source("Sec. VI, 10 to 250"),
        /// Length K of the run, the warm-up included.
        pub(super) ttis: u64 = whole(1, MAX_TTIS, 10_000).unit("TTIs"),
        /// Seed of every random stream.
        pub(super) seed: u64 = whole(0, u64::MAX, 1),
        /// Share of K that is simulated and left out of every metric.
        pub(super) warm_up: f64 = number(BELOW_ONE, 0.1),
        /// Duration τ of a TTI.
        pub(super) tau: f64 = number(POSITIVE, 1.0).unit("units of model time").source("Sec. III-A"),
    }
}

impl Run {
    /// Hands the field `preset` to `sink`, which [`super::Scenario::visit`] leaves out.
    pub(super) fn visit_preset(preset: &str, sink: &mut dyn Sink) {
        if let Some(field) = Self::SECTION.field("preset") {
            sink.field(Self::SECTION, field, Value::Text(preset));
        }
    }
}

crate::declare! {
    /// Who senses, and whom to wake. Each policy has its settings in a section of its own, which count only where it is
    /// named.
    #[derive(Clone, Debug)]
    pub(super) struct PolicyName in "policy" {
        /// The policy.
        pub(super) name: String = registered("knn").source("Sec. V, Sec. VI"),
    }
}
