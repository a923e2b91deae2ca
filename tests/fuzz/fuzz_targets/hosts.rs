//! Fuzzes the base station's host records: hosts join, get ready, leave, return, answer requested and other messages,
//! and are replaced or removed. The base station does not panic and completes a barrier only with all answers.

#![no_main]

use std::time::{Duration, Instant};

use libfuzzer_sys::arbitrary::{Result, Unstructured};
use libfuzzer_sys::fuzz_target;
use reveille_bs::scenario::{Override, load};
use reveille_bs::server::admission::{Admission, Assignment, JoiningHost};
use reveille_bs::server::barrier::{Barrier, GrantOptions};
use reveille_bs::server::failover::LostHosts;
use reveille_bs::server::roster::Roster;
use reveille_common::codec;
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{
    DeviceCheckpoint, FailedTransmission, HostAnswer, HostCheckpoint, Report, ResumePoint, WakeOutcome,
};
use reveille_common::secret::{HostCredential, Secret};
use reveille_common::units::Energy;

const DEVICES: u32 = 12;

/// The base station's host records, driven by the fuzzer.
struct Books {
    admission: Admission,
    barrier: Barrier,
    losses: LostHosts,
    passes: Vec<HostCredential>,
    is_running: bool,
    /// Whether the run waits for lost hosts or continues without their devices.
    waits: bool,
    now: Instant,
    tti: u64,
}

/// Barrier that the fuzz target expects to be open.
#[derive(Clone, Copy, PartialEq)]
enum Open {
    Nothing,
    Grant,
    Wake,
    Ledgers,
}

impl Books {
    fn new(waits: bool) -> Self {
        let set = Override::parse(&format!("devices={DEVICES}")).expect("an override");
        let scenario = load("quick", &[set]).expect("a preset").scenario;
        let deployment = Deployment::new(&scenario);
        Self {
            admission: Admission::new(DEVICES),
            barrier: Barrier::new(Roster::new(deployment.devices, scenario.sensing.psi)),
            losses: LostHosts::default(),
            passes: Vec::new(),
            is_running: false,
            waits,
            now: Instant::now(),
            tti: 0,
        }
    }

    fn newcomer(&self, input: &mut Unstructured<'_>) -> Result<JoiningHost> {
        Ok(JoiningHost {
            nonce: u64::from(input.arbitrary::<u8>()?),
            token: Secret::new(input.arbitrary()?),
            name: "a host".to_owned(),
            count: input.int_in_range(0..=2 * DEVICES)?,
            asked: self.now,
        })
    }

    fn enter(&mut self, places: Assignment, token: Secret) {
        let pass = HostCredential {
            host: places.host,
            token,
        };
        assert!(self.admission.is_valid(pass));
        self.passes.push(pass);
    }

    fn join(&mut self, input: &mut Unstructured<'_>) -> Result<()> {
        let newcomer = self.newcomer(input)?;
        let token = newcomer.token;
        if self.admission.find_by_nonce(newcomer.nonce).is_some() {
            return Ok(());
        }
        if self.is_running {
            if !self.waits {
                return Ok(());
            }
            if let Some((lost, _)) = self.losses.find_takeover(newcomer.count) {
                let places = self.admission.take_over(newcomer, lost);
                self.losses.offer(lost.host, places.host);
                self.enter(places, token);
            }
        } else if let Some(places) = self.admission.join(newcomer) {
            self.enter(places, token);
        }
        Ok(())
    }

    /// Starts the run when all hosts are ready.
    fn begin(&mut self) {
        if let Some(hosts) = self.admission.all_ready().filter(|_| !self.is_running) {
            let mut carried = vec![false; DEVICES as usize];
            for places in &hosts {
                for device in places.first.0..=places.last().0 {
                    assert!(!std::mem::replace(&mut carried[device as usize], true), "carried twice");
                }
            }
            assert!(carried.iter().all(|is_carried| *is_carried));
            self.barrier.roster().set_hosts(hosts);
            self.is_running = true;
        }
    }

    fn alive(&mut self, pass: HostCredential, is_alive: bool) {
        if !self.admission.is_valid(pass) {
            return;
        }
        self.admission.set_alive(pass.host, is_alive);
        if is_alive {
            if let Some(newcomer) = self.losses.restore(pass.host, self.now).flatten() {
                self.admission.revoke(newcomer);
            }
            self.fill(pass.host);
        } else if !self.is_running {
            self.admission.leave(pass.host);
        } else if self.losses.offer_for(pass.host).is_some() {
            self.losses.decline(pass.host);
            self.admission.revoke(pass.host);
        } else if let Some(places) = self.admission.assignment(pass.host) {
            self.losses.lose(places, self.now);
        }
    }

    fn fill(&mut self, host: HostId) {
        if self.admission.carries(host)
            && let Some((lost, _)) = self.losses.complete_takeover(host, self.now)
            && let Some(places) = self.admission.assignment(host)
        {
            self.admission.revoke(lost.host);
            self.barrier.roster().replace(lost.host, places);
        }
    }

    /// Continues the run without the devices of lost hosts.
    fn give_up(&mut self) {
        let lost: Vec<Assignment> = self.losses.places().collect();
        for places in lost {
            self.losses.drop_host(places.host);
            self.admission.revoke(places.host);
            self.barrier.lose(places.host);
        }
    }

    fn restore(&mut self) {
        let next = Tti(self.tti);
        for places in self.losses.needing_replay(next) {
            let devices = vec![DeviceCheckpoint(Vec::new()); places.count as usize];
            let at = ResumePoint { next, plan_from: None };
            self.losses.set_checkpoint(places.host, HostCheckpoint { at, devices });
        }
    }

    fn hear(&mut self, input: &mut Unstructured<'_>) -> Result<()> {
        let host = HostId(input.int_in_range(0..=20)?);
        let device = DeviceId(input.int_in_range(0..=DEVICES)?);
        let tti = Tti(self.tti.saturating_sub(input.int_in_range(0..=2)?));
        let battery = Energy::from_micro(input.arbitrary::<u32>()?.into());
        let failure = FailedTransmission {
            device,
            drained: battery,
        };
        match input.int_in_range(0..=4)? {
            0 => {
                let report = Report {
                    device,
                    tti,
                    information: input.arbitrary()?,
                    battery,
                };
                self.barrier.report(host, report);
            }
            1 => {
                let answer = HostAnswer::Done {
                    host,
                    tti,
                    reports: input.arbitrary()?,
                    failures: if input.arbitrary()? { vec![failure] } else { Vec::new() },
                    totals: None,
                    views: None,
                };
                self.barrier.answer(host, answer);
            }
            2 => {
                let outcome = match input.int_in_range(0..=2)? {
                    0 => WakeOutcome::Unheard,
                    1 => WakeOutcome::Failed(failure),
                    _ => WakeOutcome::Late {
                        spent: battery,
                        powered: input.arbitrary()?,
                    },
                };
                self.barrier.answer(host, HostAnswer::NotWoken { device, tti, outcome });
            }
            3 => {
                let ledgers = Vec::new();
                self.barrier.answer(host, HostAnswer::Final { host, ledgers });
            }
            _ => {
                let length = input.int_in_range(0..=64)?;
                if let Ok(answer) = codec::decode::<HostAnswer>(input.bytes(length)?) {
                    self.barrier.answer(host, answer);
                }
            }
        }
        Ok(())
    }

    /// Has every host with devices answer that nothing happened; this must complete the barrier.
    fn answer_quietly(&mut self) {
        let tti = Tti(self.tti);
        for host in self.barrier.missing_hosts() {
            let answer = HostAnswer::Done {
                host,
                tti,
                reports: 0,
                failures: Vec::new(),
                totals: None,
                views: None,
            };
            self.barrier.answer(host, answer);
        }
    }
}

fn play(input: &mut Unstructured<'_>) -> Result<()> {
    let mut books = Books::new(input.arbitrary()?);
    let mut open = Open::Nothing;
    while !input.is_empty() {
        books.now += Duration::from_millis(100);
        let pass = |books: &Books, at: usize| books.passes.get(at % books.passes.len().max(1)).copied();
        match input.int_in_range(0..=11)? {
            0 => books.join(input)?,
            1 => {
                if let Some(pass) = pass(&books, input.arbitrary()?)
                    && books.admission.ready(pass)
                {
                    books.fill(pass.host);
                }
            }
            2 | 3 => {
                if let Some(pass) = pass(&books, input.arbitrary()?) {
                    books.alive(pass, input.ratio(3, 4)?);
                }
            }
            4 => books.begin(),
            5 if !books.waits => books.give_up(),
            6 if books.waits => books.restore(),
            7 if books.is_running && open == Open::Nothing => {
                books.tti += 1;
                books
                    .barrier
                    .expect_grant(Tti(books.tti), input.arbitrary()?, GrantOptions::default());
                open = Open::Grant;
            }
            8 if books.is_running && open == Open::Nothing => {
                let device = DeviceId(input.int_in_range(0..=DEVICES - 1)?);
                books.barrier.expect_wake(Tti(books.tti), device);
                open = Open::Wake;
            }
            9 if books.is_running && open == Open::Nothing => {
                books.barrier.expect_ledgers();
                open = Open::Ledgers;
            }
            10 => {
                if open == Open::Grant {
                    books.answer_quietly();
                }
            }
            _ => books.hear(input)?,
        }
        let waiting = books.barrier.missing_hosts();
        let is_early = books.barrier.is_complete() && open != Open::Wake && !waiting.is_empty();
        assert!(!is_early, "{waiting:?} have not answered");
        if books.barrier.is_complete() {
            match open {
                Open::Nothing => {}
                Open::Grant => drop(books.barrier.take_grant_result()),
                Open::Wake => drop(books.barrier.take_outcome()),
                Open::Ledgers => drop(books.barrier.take_ledgers()),
            }
            open = Open::Nothing;
        }
    }
    Ok(())
}

fuzz_target!(|data: &[u8]| {
    // Running out of fuzzer input ends the case.
    let _done = play(&mut Unstructured::new(data));
});
