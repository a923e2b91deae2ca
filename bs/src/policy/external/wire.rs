//! What is said at the policy port, in [`Form`](reveille_common::forms::Form)s that any language reads.
//!
//! ```text
//!   BS                                                    policy process
//!    │ hello: protocol min..max, run, K, N, features, known       │
//!    ├───────────────────────────────────────────────────────────►│
//!    │                       id, name, key, protocol, form        │
//!    │◄───────────────────────────────────────────────────────────┤
//!    │ plan | wake: seq, tti, to (the id), device, globals, mask  │
//!    ├───────────────────────────────────────────────────────────►│
//!    │         the same seq, tti and stage; id, key; the decision │
//!    │◄───────────────────────────────────────────────────────────┤
//!    │ bye: the run is over                                       │
//!    ├───────────────────────────────────────────────────────────►│
//! ```
//! Virtual time stands from a question to its answer. The same question may come again, as after a lost link: `seq`
//! says so, and who decides by more than the question answers as before. An answer that echoes another question is not
//! taken for this one. Fields that are not known are an error in an answer, and are to be left alone in a
//! question: later versions add some.

use reveille_common::forms::{Octets, Rows};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::{DutyCycle, Plan};
use serde::{Deserialize, Serialize};

use super::features::{DEVICE, Feature, GLOBAL};
use super::question::{Answer, Decision, Question, Stage};
use crate::knowledge::Knowledge;

/// The version that is spoken here.
pub const PROTOCOL: u32 = 1;
/// The oldest version that is understood here.
pub const OLDEST: u32 = 1;

/// What is asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Said {
    /// Who is there.
    Hello,
    /// [`Stage::Plan`].
    Plan,
    /// [`Stage::Wake`].
    Wake,
    /// The run is over; nothing is to be answered.
    Bye,
}

impl From<Stage> for Said {
    fn from(stage: Stage) -> Self {
        match stage {
            Stage::Plan => Self::Plan,
            Stage::Wake => Self::Wake,
        }
    }
}

/// What all that is said begins with; all that is looked at before the rest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Head {
    /// The version of who says it.
    pub protocol: u32,
    /// The number of the decision in the run, from 0; an answer echoes it.
    pub seq: u64,
    /// The TTI of the decision; an answer echoes it.
    pub tti: u64,
    /// What is asked; an answer echoes it.
    pub stage: Said,
}

/// A feature by name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Column {
    /// Its name.
    pub name: String,
    /// What it says.
    pub about: String,
}

impl From<&Feature> for Column {
    fn from(feature: &Feature) -> Self {
        Self {
            name: feature.name.to_owned(),
            about: feature.about.to_owned(),
        }
    }
}

/// What a base station knows of a device, in the units of the scenario.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct KnownDevice {
    /// Position along the width, m.
    pub x: f64,
    /// Position along the height, m.
    pub y: f64,
    /// `E_max`.
    pub e_max: f64,
    /// `E_idle`.
    pub e_idle: f64,
    /// `E_WuR`.
    pub e_wur: f64,
    /// `E_Tx`.
    pub e_tx: f64,
    /// Its mean harvest in a TTI.
    pub mean_harvest: f64,
}

/// What a base station knows before TTI 0, and nothing that it could not.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Known {
    /// Width of the area, m.
    pub width: f64,
    /// Height of the area, m.
    pub height: f64,
    /// α.
    pub alpha: f64,
    /// Ψ.
    pub psi: f64,
    /// The distance beyond which no device detects an event, m.
    pub d_max: f64,
    /// The devices, in the order of ids.
    pub devices: Vec<KnownDevice>,
}

impl From<&Knowledge> for Known {
    fn from(known: &Knowledge) -> Self {
        let devices = known.devices.iter().map(|device| KnownDevice {
            x: device.position.x,
            y: device.position.y,
            e_max: device.energy.e_max.units(),
            e_idle: device.energy.e_idle.units(),
            e_wur: device.energy.e_wur.units(),
            e_tx: device.energy.e_tx.units(),
            mean_harvest: device.mean_harvest.units(),
        });
        Self {
            width: known.area.width,
            height: known.area.height,
            alpha: known.alpha,
            psi: known.sensing.psi,
            d_max: known.sensing.d_max,
            devices: devices.collect(),
        }
    }
}

/// The first question to a policy process. It is in JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// Its head.
    #[serde(flatten)]
    pub head: Head,
    /// The oldest version that the BS understands.
    pub min: u32,
    /// The newest.
    pub max: u32,
    /// The run.
    pub run: String,
    /// The release of the BS.
    pub reveille: String,
    /// K.
    pub ttis: u64,
    /// What the columns of [`Asked::device`] are.
    pub device_features: Vec<Column>,
    /// What [`Asked::globals`] are.
    pub global_features: Vec<Column>,
    /// What is known before TTI 0.
    pub known: Known,
    /// Who has answered the last greeting and cannot decide, and why.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<Refused>,
}

/// A process that cannot decide.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refused {
    /// Its id.
    pub id: String,
    /// Why not.
    pub why: String,
}

impl Hello {
    /// The greeting of the BS of `run`, before the first decision.
    pub fn new(run: String, known: &Knowledge) -> Self {
        Self {
            head: Head {
                protocol: PROTOCOL,
                seq: 0,
                tti: 0,
                stage: Said::Hello,
            },
            min: OLDEST,
            max: PROTOCOL,
            run,
            reveille: env!("CARGO_PKG_VERSION").to_owned(),
            ttis: known.ttis,
            device_features: DEVICE.iter().map(Column::from).collect(),
            global_features: GLOBAL.iter().map(Column::from).collect(),
            known: known.into(),
            refused: None,
        }
    }
}

/// The answer to [`Hello`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Welcome {
    /// Its head.
    #[serde(flatten)]
    pub head: Head,
    /// By what the process tells itself from others: it answers questions to this id alone.
    pub id: String,
    /// What it is called, for people.
    #[serde(default)]
    pub name: String,
    /// The run's key.
    #[serde(default)]
    pub key: String,
    /// The form in which it wants its questions.
    #[serde(default)]
    pub form: reveille_common::forms::Form,
}

/// A report that was heard.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeardReport {
    /// Whose.
    pub device: u32,
    /// I of it.
    pub information: f64,
    /// The battery that it tells of.
    pub battery: f64,
}

/// A question.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Asked {
    /// Its head.
    #[serde(flatten)]
    pub head: Head,
    /// The id of the process that is asked.
    pub to: String,
    /// A row for each device, in the order of ids, with the features of [`Hello::device_features`].
    pub device: Rows,
    /// A row with the features of [`Hello::global_features`].
    pub globals: Rows,
    /// What can be answered for each device: 2 for either, 0 for what would be dropped.
    pub action_mask: Octets,
    /// At [`Said::Wake`], the reports of this TTI in the order in which they came; else nothing.
    pub heard: Vec<HeardReport>,
    /// Why the last answer to this question was not taken.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
}

impl Asked {
    /// `question` as decision `seq` to the process with this id.
    pub fn new(question: &Question<'_>, seq: u64, to: &str) -> Self {
        let n = question.woken.len();
        let mut device = vec![0.0; n * DEVICE.len()];
        let (mut globals, mut mask) = (vec![0.0; GLOBAL.len()], vec![0; n]);
        question.write_devices(&mut device);
        question.write_global(&mut globals);
        question.write_mask(&mut mask);
        let heard = match question.stage {
            Stage::Plan => &[],
            Stage::Wake => question.heard,
        };
        Self {
            head: Head {
                protocol: PROTOCOL,
                seq,
                tti: question.seen.now.0,
                stage: question.stage.into(),
            },
            to: to.to_owned(),
            device: Rows {
                width: DEVICE.len(),
                values: device,
            },
            globals: Rows {
                width: GLOBAL.len(),
                values: globals,
            },
            action_mask: Octets(mask.into_iter().map(i8::cast_unsigned).collect()),
            heard: heard
                .iter()
                .map(|report| HeardReport {
                    device: report.device.0,
                    information: report.information,
                    battery: report.battery.units(),
                })
                .collect(),
            refused: None,
        }
    }
}

/// What an answer shows of who gave it; looked at before the rest.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct Shown {
    /// The id of the process.
    pub id: String,
    /// The run's key.
    #[serde(default)]
    pub key: String,
}

/// An answer. Exactly one of `action`, `sense`, `cycles` and `wake` says what is decided.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reply {
    /// The version of the process.
    pub protocol: u32,
    /// As asked.
    pub seq: u64,
    /// As asked.
    pub tti: u64,
    /// As asked.
    pub stage: Option<Said>,
    /// The id of the process.
    pub id: String,
    /// The run's key.
    #[serde(default)]
    pub key: String,
    /// A zero or a one for each device: who senses, or whom to wake in the order of ids.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub action: Option<Octets>,
    /// The devices that sense; the others sleep.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sense: Option<Vec<u32>>,
    /// For each device `[t_on, t_drx, offset]`: it senses in the first `t_on` of every `t_drx` TTIs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cycles: Option<Vec<[u32; 3]>>,
    /// The devices to wake, in this order; nobody ends the wake-ups of the TTI.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wake: Option<Vec<u32>>,
    /// The TTI in which to be asked for a plan again, if that is not the next.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<u64>,
}

impl Reply {
    /// An empty answer to the question with this `head`.
    pub fn to(head: &Head, id: &str, key: &str) -> Self {
        Self {
            protocol: PROTOCOL,
            seq: head.seq,
            tti: head.tti,
            stage: Some(head.stage),
            id: id.to_owned(),
            key: key.to_owned(),
            ..Self::default()
        }
    }

    /// The same with what `answer` says.
    #[must_use]
    pub fn with(self, answer: &Answer) -> Self {
        match answer {
            Answer::Plan(Decision { plan, next }) => {
                let next = (next.0 > self.tti + 1).then_some(next.0);
                match plan {
                    Plan::Bits { bits } => {
                        let sense = Some(Plan::chosen(bits).map(|device| device.0).collect());
                        Self { sense, next, ..self }
                    }
                    Plan::Periodic(cycles) => {
                        let three = |cycle: &DutyCycle| [cycle.t_on, cycle.t_drx, cycle.offset];
                        let cycles = Some(cycles.iter().map(three).collect());
                        Self { cycles, next, ..self }
                    }
                }
            }
            Answer::Wake(devices) => Self {
                wake: Some(devices.iter().map(|device| device.0).collect()),
                ..self
            },
        }
    }

    /// What it decides at `stage` in TTI `tti`, for N = `devices`.
    ///
    /// # Errors
    /// Why it decides nothing, in words for who wrote the process.
    pub fn answer(&self, stage: Stage, tti: Tti, devices: u32) -> Result<Answer, String> {
        if !(OLDEST..=PROTOCOL).contains(&self.protocol) {
            let own = self.protocol;
            return Err(format!(
                "it is in protocol {own}, this base station speaks {OLDEST} to {PROTOCOL}"
            ));
        }
        let said = [
            ("action", self.action.is_some()),
            ("sense", self.sense.is_some()),
            ("cycles", self.cycles.is_some()),
            ("wake", self.wake.is_some()),
        ];
        let said: Vec<&str> = said
            .iter()
            .filter(|(_, is_said)| *is_said)
            .map(|(name, _)| *name)
            .collect();
        let allowed: &[&str] = match stage {
            Stage::Plan => &["action", "sense", "cycles"],
            Stage::Wake => &["action", "wake"],
        };
        let [one] = said[..] else {
            return Err(format!("one of {} is to be said, not {said:?}", allowed.join(", ")));
        };
        if !allowed.contains(&one) {
            return Err(format!("{one} is no answer here; {} are", allowed.join(", ")));
        }
        match stage {
            Stage::Plan => {
                let next = self.next.map_or(tti + 1, Tti);
                if next <= tti {
                    return Err(format!("next is {next}, and must be after TTI {tti}"));
                }
                let plan = self.plan(devices)?;
                Ok(Answer::Plan(Decision { plan, next }))
            }
            Stage::Wake if self.next.is_some() => Err("next goes with a plan, not with wake-ups".to_owned()),
            Stage::Wake => match (&self.wake, &self.action) {
                (Some(wake), _) => Ok(Answer::Wake(known(wake, devices)?)),
                (None, action) => Ok(Answer::Wake(chosen(action.as_ref(), devices)?)),
            },
        }
    }

    fn plan(&self, devices: u32) -> Result<Plan, String> {
        if let Some(cycles) = &self.cycles {
            if cycles.len() != devices as usize {
                return Err(format!("{} cycles for {devices} devices", cycles.len()));
            }
            let cycles = cycles.iter().enumerate().map(|(j, &[t_on, t_drx, offset])| {
                let cycle = DutyCycle { t_on, t_drx, offset };
                cycle.is_valid().then_some(cycle).ok_or_else(|| {
                    format!("the cycle of device {j} is [{t_on}, {t_drx}, {offset}]: t_on ≤ t_drx, offset < t_drx")
                })
            });
            return Ok(Plan::Periodic(cycles.collect::<Result<_, _>>()?));
        }
        let on = match &self.sense {
            Some(sense) => known(sense, devices)?,
            None => chosen(self.action.as_ref(), devices)?,
        };
        Ok(Plan::from_chosen(devices as usize, &on))
    }
}

/// These devices, if there are such.
fn known(ids: &[u32], devices: u32) -> Result<Vec<DeviceId>, String> {
    match ids.iter().find(|id| **id >= devices) {
        Some(id) => Err(format!("there is no device {id}: they are 0 to {}", devices - 1)),
        None => Ok(ids.iter().copied().map(DeviceId).collect()),
    }
}

/// The devices with a one.
fn chosen(action: Option<&Octets>, devices: u32) -> Result<Vec<DeviceId>, String> {
    let bits = action.map_or(&[][..], |action| &action.0);
    if bits.len() != devices as usize {
        return Err(format!("{} numbers in action for {devices} devices", bits.len()));
    }
    if let Some(j) = bits.iter().position(|bit| *bit > 1) {
        return Err(format!("action is {} at device {j}: 0 or 1 is allowed", bits[j]));
    }
    let ones = (0..devices).filter(|j| bits[*j as usize] == 1);
    Ok(ones.map(DeviceId).collect())
}

#[cfg(test)]
mod tests {
    use reveille_common::forms::Form;

    use super::*;

    const HEAD: Head = Head {
        protocol: PROTOCOL,
        seq: 9,
        tti: 7,
        stage: Said::Plan,
    };

    fn read(text: &str) -> Result<Reply, String> {
        Form::Json.decode(text.as_bytes())
    }

    /// What `text`, behind the head of an answer, decides at `stage` for five devices.
    fn decided(stage: Stage, text: &str) -> Result<Answer, String> {
        let head = r#"{"protocol":1,"seq":9,"tti":7,"stage":"plan","id":"a","#;
        read(&format!("{head}{text}}}")).and_then(|reply| reply.answer(stage, Tti(7), 5))
    }

    #[test]
    fn a_plan_can_be_said_in_three_ways() {
        let plan = |plan, next| Ok(Answer::Plan(Decision { plan, next: Tti(next) }));
        let bits = Plan::from_bits([false, true, false, false, true]);
        assert_eq!(decided(Stage::Plan, r#""action":[0,1,0,0,1]"#), plan(bits.clone(), 8));
        assert_eq!(decided(Stage::Plan, r#""sense":[4,1],"next":30"#), plan(bits, 30));
        let cycle = |t_on, t_drx, offset| DutyCycle { t_on, t_drx, offset };
        let cycles = Plan::Periodic(vec![
            cycle(1, 4, 3),
            cycle(0, 1, 0),
            cycle(2, 2, 1),
            cycle(1, 9, 0),
            cycle(1, 1, 0),
        ]);
        let text = r#""cycles":[[1,4,3],[0,1,0],[2,2,1],[1,9,0],[1,1,0]]"#;
        assert_eq!(decided(Stage::Plan, text), plan(cycles, 8));
    }

    #[test]
    fn wake_ups_can_be_said_in_two() {
        let wake = |ids: &[u32]| Ok(Answer::Wake(ids.iter().copied().map(DeviceId).collect()));
        assert_eq!(decided(Stage::Wake, r#""action":[0,1,0,0,1]"#), wake(&[1, 4]));
        assert_eq!(decided(Stage::Wake, r#""wake":[4,1]"#), wake(&[4, 1]));
        assert_eq!(decided(Stage::Wake, r#""wake":[]"#), wake(&[]));
    }

    #[test]
    fn what_decides_nothing_is_refused_with_what_is_wrong() {
        let refused = [
            (Stage::Plan, r#""name":"x""#, "unknown field"),
            (Stage::Plan, r#""next":9"#, "one of action, sense, cycles"),
            (Stage::Plan, r#""sense":[],"action":[0,0,0,0,0]"#, "one of"),
            (Stage::Plan, r#""wake":[1]"#, "wake is no answer here"),
            (Stage::Wake, r#""sense":[1]"#, "sense is no answer here"),
            (Stage::Wake, r#""wake":[1],"next":9"#, "next goes with a plan"),
            (Stage::Plan, r#""sense":[5]"#, "no device 5: they are 0 to 4"),
            (Stage::Wake, r#""wake":[4294967295]"#, "no device 4294967295"),
            (Stage::Plan, r#""action":[0,1]"#, "2 numbers in action for 5 devices"),
            (Stage::Plan, r#""action":[0,1,2,0,0]"#, "2 at device 2"),
            (Stage::Plan, r#""sense":[1],"next":7"#, "must be after TTI 7"),
            (Stage::Plan, r#""cycles":[[1,1,0]]"#, "1 cycles for 5 devices"),
            (
                Stage::Plan,
                r#""cycles":[[1,1,0],[1,0,0],[1,1,0],[1,1,0],[1,1,0]]"#,
                "device 1 is [1, 0, 0]",
            ),
        ];
        for (stage, text, why) in refused {
            let said = decided(stage, text).expect_err(text);
            assert!(said.contains(why), "{text}: {said}");
        }
    }

    #[test]
    fn what_is_decided_comes_back() {
        let decisions = [
            Answer::Plan(Decision {
                plan: Plan::from_bits([true, false, false, true, true]),
                next: Tti(8),
            }),
            Answer::Plan(Decision {
                plan: Plan::Periodic(vec![DutyCycle::SENSING; 5]),
                next: Tti::NEVER,
            }),
            Answer::Wake(vec![DeviceId(3), DeviceId(0)]),
        ];
        for answer in decisions {
            for form in [Form::Json, Form::Cbor] {
                let reply = Reply::to(&HEAD, "a", "").with(&answer);
                let read: Reply = form.decode(&form.encode(&reply)).expect("an answer");
                assert_eq!(read, reply);
                assert_eq!(read.answer(answer.stage(), Tti(7), 5), Ok(answer.clone()));
            }
        }
    }
}
