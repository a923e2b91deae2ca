//! Fuzzes `GrantFollower` (device crate) against a simple model, with plans, grants and wake-ups in any order. The
//! follower must execute each TTI once and in order, with the δ of the latest plan, and must not panic. The target does
//! not check that the host makes progress: `NotReady` is accepted at any time. Not exercised: changes by operators, a
//! radio that loses plans, and a host that resumes a run.
//!
//! tests/fuzz/README.md shows how to run it. The order of the draws defines the meaning of a corpus file.

#![no_main]

use libfuzzer_sys::arbitrary::{Result, Unstructured};
use libfuzzer_sys::fuzz_target;
use reveille_common::codec;
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, EventId, Tti};
use reveille_common::message::{ClockMessage, GrantMessage, PlanUpdate, ResumePoint, WakeUp};
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::radio::RadioSettings;
use reveille_device::grant_follower::{Disposition, FollowerStart, GrantFollower, GrantTask, WakeUpTask};

const FIRST_DEVICE: u32 = 2;
const DEVICE_COUNT: u32 = 4;
/// Distance between neighbouring devices, which stand on a line, m.
const SPACING: f64 = 2.0;
/// Detection range, m.
const D_MAX: f64 = 4.0;
const RUN_TTIS: u64 = 60;

/// A follower, and a model of its state.
struct Host {
    follower: GrantFollower,
    /// Accepted plans, by the TTI from which they apply; never removed.
    plans: Vec<Option<Plan>>,
    /// δ by device, as the follower has reported it so far.
    duties: Vec<DutyCycle>,
    /// Wake-up latency of a device, in TTIs.
    latency: u64,
    /// First TTI that is not yet granted.
    next: u64,
    /// The last executed grant.
    last_grant: Option<GrantMessage>,
}

fn radio_with_latency(wake_latency: u64) -> RadioSettings {
    RadioSettings {
        wake_latency,
        ..RadioSettings::default()
    }
}

impl Host {
    fn new(latency: u64) -> Self {
        let duties = vec![DutyCycle::ASLEEP; DEVICE_COUNT as usize];
        let start = FollowerStart {
            first: DeviceId(FIRST_DEVICE),
            positions: (0..DEVICE_COUNT)
                .map(|j| Point::new(f64::from(j) * SPACING, 0.0))
                .collect(),
            duties: duties.clone(),
            resume_point: ResumePoint::default(),
        };
        let seed = 0;
        Self {
            follower: GrantFollower::new(start, D_MAX, Tti(RUN_TTIS), seed, &radio_with_latency(latency)),
            plans: vec![None; RUN_TTIS as usize],
            duties,
            latency,
            next: 0,
            last_grant: None,
        }
    }

    /// Sends a plan to the follower and checks whether it accepts the plan.
    fn check_plan(&mut self, update: PlanUpdate) {
        let PlanUpdate { from, plan } = update.clone();
        let is_accepted = from.0 >= self.next && from.0 < RUN_TTIS;
        assert_eq!(
            self.follower.receive_plan(update),
            is_accepted,
            "a plan from TTI {from}"
        );
        if is_accepted {
            self.plans[from.0 as usize] = Some(plan);
        }
    }

    /// Sends a grant to the follower and checks its decision.
    fn check_grant(&mut self, grant: GrantMessage) {
        match self.follower.receive_grant(grant) {
            Disposition::Retransmit => assert_eq!(
                self.last_grant.map(|last| last.last),
                Some(grant.last),
                "retransmission of a grant that is not the last one"
            ),
            Disposition::NotReady => {}
            Disposition::Execute(task) => self.check_task(grant, task),
        }
        assert_eq!(
            self.follower.next(),
            Tti(self.next),
            "first TTI that is not yet granted"
        );
    }

    /// Checks the changes of δ and the sensing devices of a grant that the follower executes.
    fn check_task(&mut self, grant: GrantMessage, task: GrantTask) {
        assert!(
            grant.first.0 == self.next && grant.last >= grant.first && grant.last.0 < RUN_TTIS,
            "out of turn, the next TTI is {}: {grant:?}",
            self.next
        );
        let mut changes = task.duty_changes.into_iter().peekable();
        let mut plan_count = 0;
        for k in grant.first.0..=grant.last.0 {
            plan_count += u32::from(self.plans[k as usize].is_some());
            while let Some((j, _, duty)) = changes.next_if(|(_, from, _)| from.0 == k) {
                assert_ne!(
                    self.duties[j], duty,
                    "a reported change of device {j} in TTI {k} changes nothing"
                );
                self.duties[j] = duty;
            }
            // Devices sleep until the first plan.
            let current_plan = self.plans[..=k as usize].iter().rev().flatten().next();
            for (j, duty) in self.duties.iter().enumerate() {
                let device = DeviceId(FIRST_DEVICE + j as u32);
                let planned = current_plan.map_or(DutyCycle::ASLEEP, |plan| plan.duty_cycle(device));
                assert_eq!(*duty, planned, "δ of device {j} in TTI {k}");
            }
        }
        assert!(changes.next().is_none(), "changes of TTIs outside the grant");
        assert_eq!(plan_count, grant.plan_count, "number of plans in the grant");
        let current_plan_from = (0..=grant.last.0).rev().find(|&k| self.plans[k as usize].is_some());
        assert_eq!(
            current_plan_from,
            Some(grant.plan_from.0),
            "first TTI of the current plan"
        );
        let detecting_devices: Vec<usize> = (0..self.duties.len())
            .filter(|&j| {
                let is_in_range = |stimulus: Stimulus| {
                    (stimulus.epicentre.x - j as f64 * SPACING).hypot(stimulus.epicentre.y) <= D_MAX
                };
                self.duties[j].is_on(grant.last) && grant.stimulus.is_some_and(is_in_range)
            })
            .collect();
        assert_eq!(task.sensing_devices, detecting_devices);
        (self.next, self.last_grant) = (grant.last.0 + 1, Some(grant));
    }

    /// Whether a wake-up sent in TTI `tti` can follow other wake-ups of `grant`, each of which takes the latency.
    fn is_in_wake_up_chain(&self, grant: &GrantMessage, tti: Tti) -> bool {
        // Drawn TTIs are at most 5 after the last grant, so that no chain has 100 wake-ups.
        (0..100).any(|earlier_wake_ups| grant.last.0 + earlier_wake_ups * self.latency == tti.0)
    }

    /// Sends a wake-up to the follower and checks its decision.
    fn check_wake_up(&self, device: DeviceId, wake: WakeUp) {
        let is_own_device = (FIRST_DEVICE..FIRST_DEVICE + DEVICE_COUNT).contains(&device.0);
        let grant = self
            .last_grant
            .filter(|grant| is_own_device && grant.stimulus.is_some() && self.is_in_wake_up_chain(grant, wake.tti));
        let expected_task = grant.map(|grant| WakeUpTask {
            device: (device.0 - FIRST_DEVICE) as usize,
            tti: grant.last,
            stimulus: grant.stimulus.filter(|_| wake.tti.0 + self.latency <= grant.stimulus_last.0),
        });
        assert_eq!(self.follower.receive_wake_up(device, wake), expected_task);
    }

    /// Requests the ledgers and checks the decision. Returns whether the follower accepts the end of the run before TTI
    /// `end`.
    fn check_ledger_request(&mut self, end: Tti) -> bool {
        let is_accepted = self.follower.receive_collect_ledgers(end) == Disposition::Execute(());
        assert_eq!(is_accepted, end.0 == self.next, "ledgers at the end before TTI {end}");
        is_accepted
    }
}

/// Draws a TTI from 2 before `next` to 4 after it.
fn draw_tti_near(next: u64, input: &mut Unstructured<'_>) -> Result<Tti> {
    Ok(Tti((next + input.int_in_range(0..=6)?).saturating_sub(2)))
}

fn draw_duty_cycle(input: &mut Unstructured<'_>) -> Result<DutyCycle> {
    let t_drx = input.int_in_range(1..=4)?;
    Ok(DutyCycle {
        t_on: input.int_in_range(0..=t_drx)?,
        t_drx,
        offset: input.int_in_range(0..=t_drx - 1)?,
    })
}

fn draw_plan(input: &mut Unstructured<'_>) -> Result<Plan> {
    // The plan also covers devices of other hosts: those before the assignment, and one after it.
    let planned_devices = FIRST_DEVICE + DEVICE_COUNT + 1;
    Ok(if input.arbitrary()? {
        let bits: u8 = input.arbitrary()?;
        Plan::from_bits((0..planned_devices).map(|device| bits >> device & 1 == 1))
    } else {
        Plan::Periodic(
            (0..planned_devices)
                .map(|_| draw_duty_cycle(input))
                .collect::<Result<_>>()?,
        )
    })
}

fn draw_grant(host: &Host, input: &mut Unstructured<'_>) -> Result<GrantMessage> {
    let first = draw_tti_near(host.next, input)?;
    let last = Tti(first.0 + input.int_in_range(0..=4)?);
    let stimulus = if input.arbitrary()? {
        let epicentre = Point::new(
            f64::from(input.arbitrary::<u8>()?) / 32.0,
            f64::from(input.arbitrary::<i8>()?) / 32.0,
        );
        let event = EventId(input.arbitrary()?);
        Some(Stimulus { event, epicentre })
    } else {
        None
    };
    // Usually the grant that the base station would send if the host has received all of its plans.
    let is_regular = input.ratio(7, 8)?;
    let plan_ttis = |from: u64, to: u64| (from..=to.min(RUN_TTIS - 1)).filter(|&k| host.plans[k as usize].is_some());
    Ok(GrantMessage {
        first,
        last,
        stimulus,
        // From `last` to 6 TTIs after it.
        stimulus_last: draw_tti_near(last.0 + 2, input)?,
        wants_totals: input.arbitrary()?,
        wants_views: input.arbitrary()?,
        plan_from: if is_regular {
            Tti(plan_ttis(0, last.0).next_back().unwrap_or(0))
        } else {
            draw_tti_near(host.next, input)?
        },
        plan_count: if is_regular {
            plan_ttis(first.0, last.0).count() as u32
        } else {
            input.int_in_range(0..=3)?
        },
        change_count: 0,
    })
}

fn play(input: &mut Unstructured<'_>) -> Result<()> {
    let mut host = Host::new(input.int_in_range(0..=3)?);
    while !input.is_empty() {
        match input.int_in_range(0..=9)? {
            0..=2 => {
                let from = draw_tti_near(host.next, input)?;
                let plan = draw_plan(input)?;
                host.check_plan(PlanUpdate { from, plan });
            }
            3..=5 => host.check_grant(draw_grant(&host, input)?),
            // The base station repeats a grant that is not answered.
            6 => {
                if let Some(last_grant) = host.last_grant {
                    host.check_grant(last_grant);
                }
            }
            7 => {
                let tti = draw_tti_near(host.next, input)?;
                // The last id belongs to another host.
                let device = DeviceId(input.int_in_range(0..=FIRST_DEVICE + DEVICE_COUNT)?);
                host.check_wake_up(device, WakeUp { tti });
            }
            // A grant with fields that `draw_grant` never draws, such as TTIs far from the next one.
            8 => {
                let length = input.int_in_range(0..=64)?;
                if let Ok(ClockMessage::Grant(grant)) = codec::decode::<ClockMessage>(input.bytes(length)?) {
                    host.check_grant(grant);
                }
            }
            _ => {
                if host.check_ledger_request(draw_tti_near(host.next, input)?) {
                    // A host executes nothing after it has sent its ledgers.
                    return Ok(());
                }
            }
        }
    }
    Ok(())
}

fuzz_target!(|data: &[u8]| {
    // Running out of fuzzer input ends the case.
    let _result = play(&mut Unstructured::new(data));
});
