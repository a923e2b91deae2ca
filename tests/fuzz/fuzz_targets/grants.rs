//! Fuzzes the messages that a host receives about clock, plans and wake-ups, in any order. The host follows each TTI
//! once and in order, uses the latest planned δ and does not panic.

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

const FIRST: u32 = 2;
const DEVICES: u32 = 4;
const D_MAX: f64 = 4.0;
const END: u64 = 60;

/// A host, and its expected state in each TTI.
struct Host {
    follower: GrantFollower,
    /// Plans received for TTIs that were not yet granted, by TTI.
    plans: Vec<Option<Plan>>,
    /// Expected δ by device.
    duties: Vec<DutyCycle>,
    /// Wake-up latency of a device, in TTIs.
    latency: u64,
    next: u64,
    tick: Option<GrantMessage>,
}

fn radio(wake_latency: u64) -> RadioSettings {
    RadioSettings {
        wake_latency,
        ..RadioSettings::default()
    }
}

impl Host {
    fn new(latency: u64) -> Self {
        let duties = vec![DutyCycle::ASLEEP; DEVICES as usize];
        let start = FollowerStart {
            first: DeviceId(FIRST),
            positions: (0..DEVICES).map(|j| Point::new(f64::from(j) * 2.0, 0.0)).collect(),
            duties: duties.clone(),
            resume_point: ResumePoint::default(),
        };
        Self {
            follower: GrantFollower::new(start, D_MAX, Tti(END), 0, &radio(latency)),
            plans: vec![None; END as usize],
            duties,
            latency,
            next: 0,
            tick: None,
        }
    }

    fn plan(&mut self, update: PlanUpdate) {
        let PlanUpdate { from, plan } = update.clone();
        let is_due = from.0 >= self.next && from.0 < END;
        assert_eq!(self.follower.receive_plan(update), is_due);
        if is_due {
            self.plans[from.0 as usize] = Some(plan);
        }
    }

    fn grant(&mut self, tick: GrantMessage) {
        match self.follower.receive_grant(tick) {
            Disposition::Retransmit => assert_eq!(self.tick.map(|own| own.last), Some(tick.last), "another question"),
            Disposition::NotReady => {}
            Disposition::Execute(task) => self.check_task(tick, task),
        }
        assert_eq!(self.follower.next(), Tti(self.next));
    }

    fn check_task(&mut self, tick: GrantMessage, task: GrantTask) {
        assert!(
            tick.first.0 == self.next && tick.last >= tick.first && tick.last.0 < END,
            "out of turn: {tick:?}"
        );
        let mut changes = task.duty_changes.into_iter().peekable();
        let mut plans = 0;
        for k in tick.first.0..=tick.last.0 {
            plans += u32::from(self.plans[k as usize].is_some());
            while let Some((j, _, duty)) = changes.next_if(|(_, from, _)| from.0 == k) {
                assert_ne!(self.duties[j], duty, "no change at all");
                self.duties[j] = duty;
            }
            // Devices sleep until the first plan.
            let in_force = self.plans[..=k as usize].iter().rev().flatten().next();
            for (j, duty) in self.duties.iter().enumerate() {
                let device = DeviceId(FIRST + j as u32);
                let planned = in_force.map_or(DutyCycle::ASLEEP, |plan| plan.duty_cycle(device));
                assert_eq!(*duty, planned, "TTI {k}");
            }
        }
        assert!(changes.next().is_none(), "changes of other TTIs");
        assert_eq!(plans, tick.plans, "plans of the grant");
        let last = (0..=tick.last.0).rev().find(|&k| self.plans[k as usize].is_some());
        assert_eq!(last, Some(tick.plan.0), "the current plan");
        let sensing_devices: Vec<usize> = (0..self.duties.len())
            .filter(|&j| {
                let is_near = |seen: Stimulus| (seen.epicentre.x - j as f64 * 2.0).hypot(seen.epicentre.y) <= D_MAX;
                self.duties[j].is_on(tick.last) && tick.stimulus.is_some_and(is_near)
            })
            .collect();
        assert_eq!(task.sensing_devices, sensing_devices);
        (self.next, self.tick) = (tick.last.0 + 1, Some(tick));
    }

    fn wake(&self, device: DeviceId, wake: WakeUp) {
        let own = (FIRST..FIRST + DEVICES).contains(&device.0);
        let before = |tick: &GrantMessage| (0..100).find(|before| tick.last.0 + before * self.latency == wake.tti.0);
        let tick = self
            .tick
            .filter(|tick| own && tick.stimulus.is_some() && before(tick).is_some());
        let expected = tick.map(|tick| WakeUpTask {
            device: (device.0 - FIRST) as usize,
            tti: tick.last,
            stimulus: tick.stimulus.filter(|_| wake.tti.0 + self.latency <= tick.until.0),
        });
        assert_eq!(self.follower.receive_wake_up(device, wake), expected);
    }

    fn finish(&mut self, end: Tti) -> bool {
        let disposition = self.follower.receive_collect_ledgers(end);
        assert_eq!(disposition == Disposition::Execute(()), end.0 == self.next);
        disposition == Disposition::Execute(())
    }
}

fn near(next: u64, input: &mut Unstructured<'_>) -> Result<Tti> {
    Ok(Tti((next + input.int_in_range(0..=6)?).saturating_sub(2)))
}

fn cycle(input: &mut Unstructured<'_>) -> Result<DutyCycle> {
    let t_drx = input.int_in_range(1..=4)?;
    Ok(DutyCycle {
        t_on: input.int_in_range(0..=t_drx)?,
        t_drx,
        offset: input.int_in_range(0..=t_drx - 1)?,
    })
}

fn plan(input: &mut Unstructured<'_>) -> Result<Plan> {
    let all = FIRST + DEVICES + 1;
    Ok(if input.arbitrary()? {
        let bits: u8 = input.arbitrary()?;
        Plan::from_bits((0..all).map(|device| bits >> device & 1 == 1))
    } else {
        Plan::Periodic((0..all).map(|_| cycle(input)).collect::<Result<_>>()?)
    })
}

fn tick(host: &Host, input: &mut Unstructured<'_>) -> Result<GrantMessage> {
    let first = near(host.next, input)?;
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
    let own = |from: u64, to: u64| (from..=to.min(END - 1)).filter(|&k| host.plans[k as usize].is_some());
    Ok(GrantMessage {
        first,
        last,
        stimulus,
        until: near(last.0 + 2, input)?,
        account: input.arbitrary()?,
        views: input.arbitrary()?,
        plan: if is_regular {
            Tti(own(0, last.0).next_back().unwrap_or(0))
        } else {
            near(host.next, input)?
        },
        plans: if is_regular {
            own(first.0, last.0).count() as u32
        } else {
            input.int_in_range(0..=3)?
        },
    })
}

fn play(input: &mut Unstructured<'_>) -> Result<()> {
    let mut host = Host::new(input.int_in_range(0..=3)?);
    while !input.is_empty() {
        match input.int_in_range(0..=9)? {
            0..=2 => {
                let from = near(host.next, input)?;
                let plan = plan(input)?;
                host.plan(PlanUpdate { from, plan });
            }
            3..=5 => host.grant(tick(&host, input)?),
            6 => {
                if let Some(last) = host.tick {
                    host.grant(last);
                }
            }
            7 => {
                let tti = near(host.next, input)?;
                host.wake(DeviceId(input.int_in_range(0..=FIRST + DEVICES)?), WakeUp { tti });
            }
            8 => {
                let length = input.int_in_range(0..=64)?;
                if let Ok(ClockMessage::Grant(tick)) = codec::decode::<ClockMessage>(input.bytes(length)?) {
                    host.grant(tick);
                }
            }
            _ => {
                if host.finish(near(host.next, input)?) {
                    // The host ignores everything after the finish message.
                    return Ok(());
                }
            }
        }
    }
    Ok(())
}

fuzz_target!(|data: &[u8]| {
    // Running out of fuzzer input ends the case.
    let _done = play(&mut Unstructured::new(data));
});
