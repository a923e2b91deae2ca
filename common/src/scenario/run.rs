//! The general fields of a run and of the base station, and the presets. Names, words, values and their order are part
//! of scenario files and of the scenario hash; a test compares the declarations with `docs/scenario.md`.

use crate::declare;
use crate::declare::{
    Alternative, POSITIVE, Preset, SHARE_BELOW_ONE, choice, choices, number, registered, whole, word,
};
use crate::ids::{MAX_DEVICES, MAX_TTIS};

/// The presets. The first one changes nothing: it is the declared defaults, from which a file starts unless it names
/// another preset. A changed default or preset changes the digests of its runs. `study/src/report/claim_rows.rs`, help
/// texts in `deploy/src/cli/`, the fuzz target `scenario` (their number) and `README.md` repeat them.
pub const PRESETS: &[Preset] = &[
    Preset {
        name: "paper",
        about: "Table II, with the calibration closest to the paper's figures",
        text: include_str!("presets/paper.toml"),
    },
    Preset {
        name: "paper-literal",
        about: "a literal reading of the paper: uniform layout, detection by p(d), events of one TTI",
        text: include_str!("presets/paper-literal.toml"),
    },
    Preset {
        name: "quick",
        about: "20 devices and 1000 TTIs of `paper`, for a first run within seconds",
        text: include_str!("presets/quick.toml"),
    },
];

/// The presets as words of the field `preset`.
const PRESET_WORDS: [Alternative; PRESETS.len()] = {
    let mut words = [Alternative { name: "", about: "" }; PRESETS.len()];
    // A `for` loop is not possible in a constant.
    let mut index = 0;
    while index < words.len() {
        words[index] = Alternative {
            name: PRESETS[index].name,
            about: PRESETS[index].about,
        };
        index += 1;
    }
    words
};

declare! {
    /// General fields of a run.
    #[derive(Clone, Debug, PartialEq)]
    pub struct RunSettings in "" {
        /// Preset with the values that the file and the command line override.
        pub preset: String = word(&PRESET_WORDS, "paper"),
        /// Number of devices N.
        pub devices: u32 = whole(1, MAX_DEVICES as u64, 50).source("Sec. VI, 10 to 250"),
        /// Length K of the run, including the warm-up.
        pub ttis: u64 = whole(1, MAX_TTIS, 10_000).unit("TTIs"),
        /// Seed of every random stream.
        pub seed: u64 = whole(0, u64::MAX, 1),
        /// Share of K that is simulated but excluded from every metric.
        pub warm_up: f64 = number(SHARE_BELOW_ONE, 0.1),
        /// Duration τ of a TTI.
        pub tau: f64 = number(POSITIVE, 1.0).unit("units of model time").source("Sec. III-A"),
    }
}

declare! {
    /// Policy that decides the δ plan and the wake-ups. The settings in a policy's section apply only if that policy is
    /// selected.
    #[derive(Clone, Debug)]
    pub(super) struct PolicyName in "policy" {
        /// Name of the policy.
        pub(super) name: String = registered("knn").source("Sec. V, Sec. VI"),
    }
}

choices! {
    /// Ranking of wake-up candidates.
    pub enum WakeUpRanking {
        /// By `P_4,2`, the probability that a device senses an event that another device has reported (Sec. III).
        P42 = "p42",
        /// By the expected information gain under a belief about the epicentre. Each report narrows the belief, and so
        /// does each device in S1 without a report.
        Posterior = "posterior",
    }
}

choices! {
    /// The base station's knowledge of battery levels.
    pub enum BatteryKnowledge {
        /// The true levels, as in the paper's state 𝒯(k).
        Oracle = "oracle",
        /// The level in the last report, updated by later commands and the mean harvest.
        Reported = "reported",
    }
}

declare! {
    /// Base station.
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct BsSettings in "bs" {
        /// Time between two synchronisation broadcasts of the δ plan, much longer than a TTI.
        pub sync_interval: u64 = whole(1, MAX_TTIS, 1000).unit("TTIs").source("Sec. V-D"),
        /// Ranking of wake-up candidates.
        pub ranking: WakeUpRanking = choice::<WakeUpRanking>("p42").source("Sec. III"),
        /// Battery levels that the policy receives, if it uses any.
        pub battery_knowledge: BatteryKnowledge = choice::<BatteryKnowledge>("oracle").source("Sec. V-B"),
    }
}
