//! Whatever a host hears of the clock, plans and wake-ups, in whatever order: it follows each TTI once and in its turn,
//! with δ as it was planned last, and without a panic.

#![no_main]

use libfuzzer_sys::arbitrary::{Result, Unstructured};
use libfuzzer_sys::fuzz_target;
use reveille_common::codec;
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, EventId, Tti};
use reveille_common::message::{Clock, PlanUpdate, Tick, WakeUp};
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::radio::Radio;
use reveille_device::follower::{Beginning, Call, Follower, Heed, Turn};

const FIRST: u32 = 2;
const DEVICES: u32 = 4;
const D_MAX: f64 = 4.0;
const END: u64 = 60;

/// A host, and what it should have in mind, TTI by TTI.
struct Host {
    follower: Follower,
    /// Plans that were heard for TTIs that had not been granted then, by TTI.
    heard: Vec<Option<Plan>>,
    /// δ by device, as it was told to change.
    duties: Vec<DutyCycle>,
    /// What a device takes to wake, in TTIs.
    latency: u64,
    next: u64,
    tick: Option<Tick>,
}

fn radio(wake_latency: u64) -> Radio {
    Radio {
        wake_latency,
        ..Radio::default()
    }
}

impl Host {
    fn new(latency: u64) -> Self {
        let duties = vec![DutyCycle::ASLEEP; DEVICES as usize];
        let beginning = Beginning {
            first: DeviceId(FIRST),
            positions: (0..DEVICES).map(|j| Point::new(f64::from(j) * 2.0, 0.0)).collect(),
            duties: duties.clone(),
            next: Tti::ZERO,
            plan: None,
        };
        Self {
            follower: Follower::new(beginning, D_MAX, Tti(END), 0, &radio(latency)),
            heard: vec![None; END as usize],
            duties,
            latency,
            next: 0,
            tick: None,
        }
    }

    fn plan(&mut self, update: PlanUpdate) {
        let PlanUpdate { from, plan } = update.clone();
        let is_due = from.0 >= self.next && from.0 < END;
        assert_eq!(self.follower.plan(update), is_due);
        if is_due {
            self.heard[from.0 as usize] = Some(plan);
        }
    }

    fn grant(&mut self, tick: Tick) {
        match self.follower.grant(tick) {
            Heed::Again => assert_eq!(self.tick.map(|own| own.last), Some(tick.last), "another question"),
            Heed::Wait => {}
            Heed::Do(turn) => self.go(tick, turn),
        }
        assert_eq!(self.follower.next(), Tti(self.next));
    }

    fn go(&mut self, tick: Tick, turn: Turn) {
        assert!(
            tick.first.0 == self.next && tick.last >= tick.first && tick.last.0 < END,
            "out of turn: {tick:?}"
        );
        let mut changes = turn.changes.into_iter().peekable();
        let mut plans = 0;
        for k in tick.first.0..=tick.last.0 {
            plans += u32::from(self.heard[k as usize].is_some());
            while let Some((j, _, duty)) = changes.next_if(|(_, from, _)| from.0 == k) {
                assert_ne!(self.duties[j], duty, "no change at all");
                self.duties[j] = duty;
            }
            // Before the first plan devices sleep.
            let in_force = self.heard[..=k as usize].iter().rev().flatten().next();
            for (j, duty) in self.duties.iter().enumerate() {
                let device = DeviceId(FIRST + j as u32);
                let planned = in_force.map_or(DutyCycle::ASLEEP, |plan| plan.duty_cycle(device));
                assert_eq!(*duty, planned, "TTI {k}");
            }
        }
        assert!(changes.next().is_none(), "changes of other TTIs");
        assert_eq!(plans, tick.plans, "plans of the grant");
        let last = (0..=tick.last.0).rev().find(|&k| self.heard[k as usize].is_some());
        assert_eq!(last, Some(tick.plan.0), "the plan in force");
        let listeners: Vec<usize> = (0..self.duties.len())
            .filter(|&j| {
                let is_near = |seen: Stimulus| (seen.epicentre.x - j as f64 * 2.0).hypot(seen.epicentre.y) <= D_MAX;
                self.duties[j].is_on(tick.last) && tick.stimulus.is_some_and(is_near)
            })
            .collect();
        assert_eq!(turn.listeners, listeners);
        (self.next, self.tick) = (tick.last.0 + 1, Some(tick));
    }

    fn wake(&self, device: DeviceId, wake: WakeUp) {
        let own = (FIRST..FIRST + DEVICES).contains(&device.0);
        let before = |tick: &Tick| (0..100).find(|before| tick.last.0 + before * self.latency == wake.tti.0);
        let tick = self
            .tick
            .filter(|tick| own && tick.stimulus.is_some() && before(tick).is_some());
        let expected = tick.map(|tick| Call {
            device: (device.0 - FIRST) as usize,
            tti: tick.last,
            stimulus: tick.stimulus.filter(|_| wake.tti.0 + self.latency <= tick.until.0),
        });
        assert_eq!(self.follower.wake(device, wake), expected);
    }

    fn finish(&mut self, end: Tti) -> bool {
        let heed = self.follower.finish(end);
        assert_eq!(heed == Heed::Do(()), end.0 == self.next);
        heed == Heed::Do(())
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

fn tick(host: &Host, input: &mut Unstructured<'_>) -> Result<Tick> {
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
    // As a rule what the base station would say, if the host has heard all of its plans.
    let told = input.ratio(7, 8)?;
    let own = |from: u64, to: u64| (from..=to.min(END - 1)).filter(|&k| host.heard[k as usize].is_some());
    Ok(Tick {
        first,
        last,
        stimulus,
        until: near(last.0 + 2, input)?,
        account: input.arbitrary()?,
        views: input.arbitrary()?,
        plan: if told {
            Tti(own(0, last.0).next_back().unwrap_or(0))
        } else {
            near(host.next, input)?
        },
        plans: if told {
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
                if let Ok(Clock::Grant(tick)) = codec::decode::<Clock>(input.bytes(length)?) {
                    host.grant(tick);
                }
            }
            _ => {
                if host.finish(near(host.next, input)?) {
                    // All that comes after it is of no use.
                    return Ok(());
                }
            }
        }
    }
    Ok(())
}

fuzz_target!(|data: &[u8]| {
    // A fuzzer that has nothing more to say has said enough.
    let _done = play(&mut Unstructured::new(data));
});
