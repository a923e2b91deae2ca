//! Messages of the policy port, between `bs/src/server/policy_port/` and a policy process
//! (`python/reveille/policy_client.py`), in JSON or CBOR ([`Encoding`]). Field names here are names on the wire, which
//! docs/policy-port.md describes.
//!
//! ```text
//!   BS                                                     policy process
//!    │ hello: min, max, run, ttis, features, known                │
//!    ├───────────────────────────────────────────────────────────►│
//!    │                                        id, name, key, form │
//!    │◄───────────────────────────────────────────────────────────┤
//!    │ plan | wake: to, device, globals, action_mask, heard       │
//!    ├───────────────────────────────────────────────────────────►│
//!    │      id, key, and action | sense | cycles | wake; next     │
//!    │◄───────────────────────────────────────────────────────────┤
//!    │ bye: the run is over                                       │
//!    ├───────────────────────────────────────────────────────────►│
//! ```
//! The diagram is abridged: every message also has the fields of [`WireHeader`], and `features` stands for
//! `device_features` and `global_features`.
//!
//! Virtual time stops between a request and its reply. The base station can repeat a request, for example after a lost
//! link. A repeated request has the same `seq`, and a process with internal state must repeat its first reply. A reply
//! that echoes another request is refused. Unknown fields are an error in a decision reply. A process must ignore
//! unknown fields in a request, since later versions of Reveille add some.

use reveille_common::encoding::{Encoding, FloatRows, Octets};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::{DutyCycle, Plan};
use serde::{Deserialize, Serialize};

use super::decision::{Decision, DecisionContext, DecisionStage, PlanDecision};
use super::features::{DEVICE_FEATURES, Feature, GLOBAL_FEATURES};
use crate::knowledge::Knowledge;

/// Protocol version of this program. Raise it for a new field of a decision reply, which an older base station refuses;
/// for a field that is renamed or changes its meaning; and for a new or moved feature column, since trained models rely
/// on the columns. A new field of a request needs no new version. `PROTOCOL` and `OLDEST` in
/// `python/reveille/policy_client.py`, and docs/policy-port.md, repeat both numbers.
pub(crate) const PROTOCOL_VERSION: u32 = 1;
/// Oldest protocol version that this program supports.
pub(crate) const OLDEST_PROTOCOL: u32 = 1;

/// Kind of a request, called `stage` on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RequestKind {
    /// Asks a policy process to identify itself.
    Hello,
    /// [`DecisionStage::Plan`].
    Plan,
    /// [`DecisionStage::Wake`].
    Wake,
    /// The run is over; no reply is expected.
    Bye,
}

impl From<DecisionStage> for RequestKind {
    fn from(stage: DecisionStage) -> Self {
        match stage {
            DecisionStage::Plan => Self::Plan,
            DecisionStage::Wake => Self::Wake,
        }
    }
}

/// Common header of all messages. A policy process decodes it first, to find the kind of request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireHeader {
    /// Newest protocol version of the sender; in a reply, the version of the reply.
    pub protocol: u32,
    /// Number of the decision in the run, from 0; 0 in a hello and a bye. A reply echoes it.
    pub seq: u64,
    /// TTI of the decision; 0 in a hello and a bye. A reply echoes it.
    pub tti: u64,
    /// Kind of request; a reply echoes it.
    pub stage: RequestKind,
}

/// Name and meaning of a feature.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FeatureInfo {
    /// Name of the feature.
    pub name: String,
    /// Meaning of the feature.
    pub about: String,
}

impl From<&Feature> for FeatureInfo {
    fn from(feature: &Feature) -> Self {
        Self {
            name: feature.name.to_owned(),
            about: feature.about.to_owned(),
        }
    }
}

/// Properties of a device that the base station knows, in the units of the scenario.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeviceInfo {
    /// Position along the width, m.
    pub x: f64,
    /// Position along the height, m.
    pub y: f64,
    /// Capacity `E_max` of the battery.
    pub e_max: f64,
    /// Energy `E_idle` of a TTI in S1.
    pub e_idle: f64,
    /// Energy `E_WuR` of a TTI in S4.
    pub e_wur: f64,
    /// Energy `E_Tx` of a report.
    pub e_tx: f64,
    /// Mean harvest in a TTI.
    pub mean_harvest: f64,
}

/// Knowledge of the base station before TTI 0, without any ground truth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SiteInfo {
    /// Width of the area, m.
    pub width: f64,
    /// Height of the area, m.
    pub height: f64,
    /// Probability α that an event starts in a TTI in which none is active.
    pub alpha: f64,
    /// Largest information Ψ of a report.
    pub psi: f64,
    /// Distance beyond which no device detects an event, m.
    pub d_max: f64,
    /// The devices, in the order of ids.
    pub devices: Vec<DeviceInfo>,
}

impl From<&Knowledge> for SiteInfo {
    fn from(known: &Knowledge) -> Self {
        let devices = known.devices.iter().map(|device| DeviceInfo {
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

/// First request to a policy process, always in JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// Common header.
    #[serde(flatten)]
    pub head: WireHeader,
    /// Oldest protocol version that the base station supports.
    pub min: u32,
    /// Newest protocol version that the base station supports.
    pub max: u32,
    /// Identifier of the run.
    pub run: String,
    /// Reveille version of the base station.
    pub reveille: String,
    /// Length K of the run, TTIs.
    pub ttis: u64,
    /// Features in the columns of [`DecisionRequest::device`].
    pub device_features: Vec<FeatureInfo>,
    /// Features in the columns of [`DecisionRequest::globals`].
    pub global_features: Vec<FeatureInfo>,
    /// Knowledge before TTI 0.
    pub known: SiteInfo,
    /// Process that replied to the last hello but was refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<RefusedProcess>,
}

/// Policy process that the base station refused.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusedProcess {
    /// Id of the process.
    pub id: String,
    /// Reason for the refusal.
    pub why: String,
}

impl Hello {
    /// Creates the hello of the base station of `run`, sent before the first decision.
    pub fn new(run: String, known: &Knowledge) -> Self {
        Self {
            head: WireHeader {
                protocol: PROTOCOL_VERSION,
                seq: 0,
                tti: 0,
                stage: RequestKind::Hello,
            },
            min: OLDEST_PROTOCOL,
            max: PROTOCOL_VERSION,
            run,
            reveille: env!("CARGO_PKG_VERSION").to_owned(),
            ttis: known.ttis,
            device_features: DEVICE_FEATURES.iter().map(FeatureInfo::from).collect(),
            global_features: GLOBAL_FEATURES.iter().map(FeatureInfo::from).collect(),
            known: known.into(),
            refused: None,
        }
    }
}

/// Reply of a policy process to [`Hello`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HelloReply {
    /// Common header.
    #[serde(flatten)]
    pub head: WireHeader,
    /// Id that distinguishes the process from others. The process answers only requests to this id.
    pub id: String,
    /// Name of the process, for display.
    #[serde(default)]
    pub name: String,
    /// The run's key.
    #[serde(default)]
    pub key: String,
    /// Encoding in which the process wants its requests. Only the wire calls it `form`.
    #[serde(default)]
    pub form: Encoding,
}

/// A received report.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReportInfo {
    /// Reporting device.
    pub device: u32,
    /// Information I of the report.
    pub information: f64,
    /// Battery level in the report, units.
    pub battery: f64,
}

/// A decision request.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DecisionRequest {
    /// Common header.
    #[serde(flatten)]
    pub head: WireHeader,
    /// Id of the process that must decide.
    pub to: String,
    /// One row per device, in the order of ids, with the features of [`Hello::device_features`].
    pub device: FloatRows,
    /// A row with the features of [`Hello::global_features`].
    pub globals: FloatRows,
    /// By device, as in a Gymnasium mask: 2 if the action may be 0 or 1, 0 if a 1 would have no effect.
    pub action_mask: Octets,
    /// At [`RequestKind::Wake`], the reports of this TTI, in the order of [`DecisionContext::reports`]; otherwise
    /// empty.
    pub heard: Vec<ReportInfo>,
    /// Reason why the last reply to this request was refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
}

impl DecisionRequest {
    /// Encodes `context` as decision request `seq` to process `to`.
    pub fn new(context: &DecisionContext<'_>, seq: u64, to: &str) -> Self {
        let n = context.device_count();
        let mut device_rows = vec![0.0; n * DEVICE_FEATURES.len()];
        let (mut globals, mut mask) = (vec![0.0; GLOBAL_FEATURES.len()], vec![0; n]);
        context.write_devices(&mut device_rows);
        context.write_globals(&mut globals);
        context.write_mask(&mut mask);
        // At `DecisionStage::Plan` the context still holds the reports of an earlier TTI.
        let reports = match context.stage {
            DecisionStage::Plan => &[],
            DecisionStage::Wake => context.reports,
        };
        Self {
            head: WireHeader {
                protocol: PROTOCOL_VERSION,
                seq,
                tti: context.observation.now.0,
                stage: context.stage.into(),
            },
            to: to.to_owned(),
            device: FloatRows {
                width: DEVICE_FEATURES.len(),
                values: device_rows,
            },
            globals: FloatRows {
                width: GLOBAL_FEATURES.len(),
                values: globals,
            },
            action_mask: Octets(mask.into_iter().map(i8::cast_unsigned).collect()),
            heard: reports
                .iter()
                .map(|report| ReportInfo {
                    device: report.device.0,
                    information: report.information,
                    battery: report.battery.units(),
                })
                .collect(),
            refused: None,
        }
    }
}

/// Credentials in a reply. The base station checks them before it decodes the rest of a decision reply, so that replies
/// of other processes do not count as invalid.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct ReplyCredentials {
    /// The id of the process.
    pub id: String,
    /// The run's key.
    #[serde(default)]
    pub key: String,
}

/// Reply to a decision request. Exactly one of `action`, `sense`, `cycles` and `wake` holds the decision. A device that
/// is named twice counts once.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
// Repeats the fields of `WireHeader` and `ReplyCredentials`: serde cannot flatten and also deny unknown fields.
#[serde(deny_unknown_fields)]
pub struct DecisionReply {
    /// Protocol version of the reply.
    pub protocol: u32,
    /// Sequence number of the request.
    pub seq: u64,
    /// TTI of the request.
    pub tti: u64,
    /// Kind of the request.
    pub stage: Option<RequestKind>,
    /// The id of the process.
    pub id: String,
    /// The run's key.
    #[serde(default)]
    pub key: String,
    /// A 0 or 1 for each device: whether it senses, or whether to wake it. Wake-ups follow the order of ids.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub action: Option<Octets>,
    /// The devices that sense; the others sleep.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sense: Option<Vec<u32>>,
    /// `[t_on, t_drx, offset]` of each device: it senses in the first `t_on` of every `t_drx` TTIs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cycles: Option<Vec<[u32; 3]>>,
    /// Devices to wake, in this order; an empty list ends the wake-ups of the TTI.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wake: Option<Vec<u32>>,
    /// TTI of the next plan request, unless it is the next TTI.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<u64>,
}

impl DecisionReply {
    /// Creates a reply without a decision to the request with this `head`, in the newest protocol version that both
    /// sides support.
    pub fn for_request(head: &WireHeader, id: &str, key: &str) -> Self {
        Self {
            protocol: head.protocol.min(PROTOCOL_VERSION),
            seq: head.seq,
            tti: head.tti,
            stage: Some(head.stage),
            id: id.to_owned(),
            key: key.to_owned(),
            ..Self::default()
        }
    }

    /// Returns the reply with this decision.
    #[must_use]
    pub fn with_decision(self, decision: &Decision) -> Self {
        match decision {
            Decision::Plan(PlanDecision { plan, next }) => {
                let next = (next.0 > self.tti + 1).then_some(next.0);
                match plan {
                    Plan::Bits { bits } => {
                        let sense = Some(Plan::sensing_devices(bits).map(|device| device.0).collect());
                        Self { sense, next, ..self }
                    }
                    Plan::Periodic(cycles) => {
                        let triple = |cycle: &DutyCycle| [cycle.t_on, cycle.t_drx, cycle.offset];
                        let cycles = Some(cycles.iter().map(triple).collect());
                        Self { cycles, next, ..self }
                    }
                }
            }
            Decision::Wake(devices) => Self {
                wake: Some(devices.iter().map(|device| device.0).collect()),
                ..self
            },
        }
    }

    /// Returns the decision at `stage` in TTI `tti`, for N = `devices`. The caller checks that the reply echoes the
    /// request and shows the credentials of the process.
    ///
    /// # Errors
    /// The reply holds no valid decision. The message is worded for the author of the process.
    pub fn decision(&self, stage: DecisionStage, tti: Tti, devices: u32) -> Result<Decision, String> {
        if !(OLDEST_PROTOCOL..=PROTOCOL_VERSION).contains(&self.protocol) {
            let version = self.protocol;
            return Err(format!(
                "it is in protocol {version}, this base station speaks {OLDEST_PROTOCOL} to {PROTOCOL_VERSION}"
            ));
        }
        let decision_fields = [
            ("action", self.action.is_some()),
            ("sense", self.sense.is_some()),
            ("cycles", self.cycles.is_some()),
            ("wake", self.wake.is_some()),
        ];
        let present: Vec<&str> = decision_fields
            .iter()
            .filter(|(_, is_present)| *is_present)
            .map(|(name, _)| *name)
            .collect();
        let allowed: &[&str] = match stage {
            DecisionStage::Plan => &["action", "sense", "cycles"],
            DecisionStage::Wake => &["action", "wake"],
        };
        // Two kinds of decision in one reply could contradict each other.
        let [field] = present[..] else {
            return Err(format!("exactly one of {} is due, not {present:?}", allowed.join(", ")));
        };
        if !allowed.contains(&field) {
            return Err(format!("{field} is not valid here; {} are", allowed.join(", ")));
        }
        match stage {
            DecisionStage::Plan => {
                let next = self.next.map_or(tti + 1, Tti);
                if next <= tti {
                    return Err(format!("next is {next}, and must be after TTI {tti}"));
                }
                let plan = self.to_plan(devices)?;
                Ok(Decision::Plan(PlanDecision { plan, next }))
            }
            DecisionStage::Wake if self.next.is_some() => Err("next is valid only with a plan".to_owned()),
            DecisionStage::Wake => match (&self.wake, &self.action) {
                (Some(wake), _) => Ok(Decision::Wake(to_device_ids(wake, devices)?)),
                (None, action) => Ok(Decision::Wake(ids_with_one(action.as_ref(), devices)?)),
            },
        }
    }

    fn to_plan(&self, devices: u32) -> Result<Plan, String> {
        if let Some(cycles) = &self.cycles {
            if cycles.len() != devices as usize {
                return Err(format!("{} cycles for {devices} devices", cycles.len()));
            }
            let cycles = cycles.iter().enumerate().map(|(j, &[t_on, t_drx, offset])| {
                let cycle = DutyCycle { t_on, t_drx, offset };
                // A period of 0, which a process can send, would divide by zero in `DutyCycle::phase`.
                cycle.is_valid().then_some(cycle).ok_or_else(|| {
                    let max = DutyCycle::MAX_T_DRX;
                    let rule = format!("t_drx from 1 to {max}, t_on ≤ t_drx and offset < t_drx");
                    format!("the cycle of device {j} is [{t_on}, {t_drx}, {offset}], and must have {rule}")
                })
            });
            return Ok(Plan::Periodic(cycles.collect::<Result<_, _>>()?));
        }
        let sensing = match &self.sense {
            Some(sense) => to_device_ids(sense, devices)?,
            None => ids_with_one(self.action.as_ref(), devices)?,
        };
        Ok(Plan::from_devices(devices as usize, &sensing))
    }
}

/// Converts the ids. Returns an error unless all are below `devices`, ≥ 1.
fn to_device_ids(ids: &[u32], devices: u32) -> Result<Vec<DeviceId>, String> {
    match ids.iter().find(|id| **id >= devices) {
        Some(id) => Err(format!("there is no device {id}; the ids are 0 to {}", devices - 1)),
        None => Ok(ids.iter().copied().map(DeviceId).collect()),
    }
}

/// Returns the devices with a 1 in `action`, in the order of ids. Without `action` the number of entries is wrong.
fn ids_with_one(action: Option<&Octets>, devices: u32) -> Result<Vec<DeviceId>, String> {
    let bits = action.map_or(&[][..], |action| &action.0);
    if bits.len() != devices as usize {
        return Err(format!("{} numbers in action for {devices} devices", bits.len()));
    }
    if let Some(j) = bits.iter().position(|bit| *bit > 1) {
        return Err(format!("action is {} at device {j}, and must be 0 or 1", bits[j]));
    }
    let ones = (0..devices).filter(|j| bits[*j as usize] == 1);
    Ok(ones.map(DeviceId).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: WireHeader = WireHeader {
        protocol: PROTOCOL_VERSION,
        seq: 9,
        tti: 7,
        stage: RequestKind::Plan,
    };

    /// Decodes a reply with these JSON fields and returns its decision at `stage` for five devices.
    fn decode_decision(stage: DecisionStage, fields: &str) -> Result<Decision, String> {
        let head = r#"{"protocol":1,"seq":9,"tti":7,"stage":"plan","id":"a","#;
        let reply: DecisionReply = Encoding::Json.decode(format!("{head}{fields}}}").as_bytes())?;
        reply.decision(stage, Tti(7), 5)
    }

    #[test]
    fn a_plan_has_three_forms() {
        let plan_decision = |plan, next| Ok(Decision::Plan(PlanDecision { plan, next: Tti(next) }));
        let bits = Plan::from_bits([false, true, false, false, true]);
        assert_eq!(
            decode_decision(DecisionStage::Plan, r#""action":[0,1,0,0,1]"#),
            plan_decision(bits.clone(), 8)
        );
        assert_eq!(
            decode_decision(DecisionStage::Plan, r#""sense":[4,1],"next":30"#),
            plan_decision(bits, 30)
        );
        let cycle = |t_on, t_drx, offset| DutyCycle { t_on, t_drx, offset };
        let cycles = Plan::Periodic(vec![
            cycle(1, 4, 3),
            cycle(0, 1, 0),
            cycle(2, 2, 1),
            cycle(1, 9, 0),
            cycle(1, 1, 0),
        ]);
        let fields = r#""cycles":[[1,4,3],[0,1,0],[2,2,1],[1,9,0],[1,1,0]]"#;
        assert_eq!(decode_decision(DecisionStage::Plan, fields), plan_decision(cycles, 8));
    }

    #[test]
    fn wake_ups_have_two_forms() {
        let wake_decision = |ids: &[u32]| Ok(Decision::Wake(ids.iter().copied().map(DeviceId).collect()));
        assert_eq!(
            decode_decision(DecisionStage::Wake, r#""action":[0,1,0,0,1]"#),
            wake_decision(&[1, 4])
        );
        assert_eq!(
            decode_decision(DecisionStage::Wake, r#""wake":[4,1]"#),
            wake_decision(&[4, 1])
        );
        assert_eq!(decode_decision(DecisionStage::Wake, r#""wake":[]"#), wake_decision(&[]));
    }

    #[test]
    fn an_invalid_decision_is_refused_with_the_reason() {
        let cases = [
            (DecisionStage::Plan, r#""name":"x""#, "unknown field"),
            (DecisionStage::Plan, r#""next":9"#, "one of action, sense, cycles"),
            (DecisionStage::Plan, r#""sense":[],"action":[0,0,0,0,0]"#, "one of"),
            (DecisionStage::Plan, r#""wake":[1]"#, "wake is not valid here"),
            (DecisionStage::Wake, r#""sense":[1]"#, "sense is not valid here"),
            (DecisionStage::Wake, r#""wake":[1],"next":9"#, "only with a plan"),
            (DecisionStage::Plan, r#""sense":[5]"#, "no device 5; the ids are 0 to 4"),
            (DecisionStage::Wake, r#""wake":[4294967295]"#, "no device 4294967295"),
            (
                DecisionStage::Plan,
                r#""action":[0,1]"#,
                "2 numbers in action for 5 devices",
            ),
            (DecisionStage::Plan, r#""action":[0,1,2,0,0]"#, "2 at device 2"),
            (DecisionStage::Plan, r#""sense":[1],"next":7"#, "must be after TTI 7"),
            (DecisionStage::Plan, r#""cycles":[[1,1,0]]"#, "1 cycles for 5 devices"),
            (
                DecisionStage::Plan,
                r#""cycles":[[1,1,0],[1,0,0],[1,1,0],[1,1,0],[1,1,0]]"#,
                "device 1 is [1, 0, 0]",
            ),
        ];
        for (stage, fields, reason) in cases {
            let error = decode_decision(stage, fields).expect_err(fields);
            assert!(error.contains(reason), "{fields}: error {error:?}, expected {reason:?}");
        }
    }

    #[test]
    fn a_decision_round_trips() {
        let decisions = [
            Decision::Plan(PlanDecision {
                plan: Plan::from_bits([true, false, false, true, true]),
                next: Tti(8),
            }),
            Decision::Plan(PlanDecision {
                plan: Plan::Periodic(vec![DutyCycle::SENSING; 5]),
                next: Tti::NEVER,
            }),
            Decision::Wake(vec![DeviceId(3), DeviceId(0)]),
        ];
        for decision in decisions {
            for encoding in [Encoding::Json, Encoding::Cbor] {
                let reply = DecisionReply::for_request(&HEAD, "a", "").with_decision(&decision);
                let decoded: DecisionReply = encoding.decode(&encoding.encode(&reply)).expect("a reply");
                assert_eq!(decoded, reply);
                assert_eq!(decoded.decision(decision.stage(), Tti(7), 5), Ok(decision.clone()));
            }
        }
    }

    #[test]
    fn a_reply_has_the_newest_protocol_version_of_both_sides() {
        for (bs_protocol, expected) in [(0, 0), (PROTOCOL_VERSION + 1, PROTOCOL_VERSION)] {
            let head = WireHeader {
                protocol: bs_protocol,
                ..HEAD
            };
            assert_eq!(DecisionReply::for_request(&head, "a", "").protocol, expected);
        }
    }
}
