//! Whatever hosts do, in whatever order: they join, are ready, come and go, answer what was asked and what was not, and
//! are replaced or given up. The base station keeps its books without a panic, and is never satisfied by less than all
//! answers.

#![no_main]

use std::time::{Duration, Instant};

use libfuzzer_sys::arbitrary::{Result, Unstructured};
use libfuzzer_sys::fuzz_target;
use reveille_bs::host::admission::{Admission, Newcomer, Places};
use reveille_bs::host::barrier::{Asked, Barrier};
use reveille_bs::host::losses::Losses;
use reveille_bs::host::roster::Roster;
use reveille_bs::scenario::{Override, load};
use reveille_common::codec;
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{Answer, Checkpoint, Failure, Report, Resumption, WakeOutcome};
use reveille_common::secret::{HostPass, Secret};
use reveille_common::units::Energy;

const DEVICES: u32 = 12;

/// A base station's books, and what a fuzzer does with them.
struct Books {
    admission: Admission,
    barrier: Barrier,
    losses: Losses,
    passes: Vec<HostPass>,
    is_running: bool,
    /// Whether the run waits for what is lost, or goes on without it.
    waits: bool,
    now: Instant,
    tti: u64,
}

/// What is waited for, as far as this program knows.
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
        let scenario = load("quick", &[set]).expect("a preset");
        let deployment = Deployment::new(&scenario);
        Self {
            admission: Admission::new(DEVICES),
            barrier: Barrier::new(Roster::new(deployment.devices, scenario.sensing.psi)),
            losses: Losses::default(),
            passes: Vec::new(),
            is_running: false,
            waits,
            now: Instant::now(),
            tti: 0,
        }
    }

    fn newcomer(&self, input: &mut Unstructured<'_>) -> Result<Newcomer> {
        Ok(Newcomer {
            nonce: u64::from(input.arbitrary::<u8>()?),
            token: Secret::new(input.arbitrary()?),
            name: "a host".to_owned(),
            count: input.int_in_range(0..=2 * DEVICES)?,
            asked: self.now,
        })
    }

    fn enter(&mut self, places: Places, token: Secret) {
        let pass = HostPass {
            host: places.host,
            token,
        };
        assert!(self.admission.is_valid(pass));
        self.passes.push(pass);
    }

    fn join(&mut self, input: &mut Unstructured<'_>) -> Result<()> {
        let newcomer = self.newcomer(input)?;
        let token = newcomer.token;
        if self.admission.known(newcomer.nonce).is_some() {
            return Ok(());
        }
        if self.is_running {
            if !self.waits {
                return Ok(());
            }
            if let Some((lost, _)) = self.losses.fitting(newcomer.count) {
                let places = self.admission.take_over(newcomer, lost);
                self.losses.offer(lost.host, places.host);
                self.enter(places, token);
            }
        } else if let Some(places) = self.admission.join(newcomer) {
            self.enter(places, token);
        }
        Ok(())
    }

    /// The run begins once everybody is there.
    fn begin(&mut self) {
        if let Some(hosts) = self.admission.complete().filter(|_| !self.is_running) {
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

    fn alive(&mut self, pass: HostPass, is_alive: bool) {
        if !self.admission.is_valid(pass) {
            return;
        }
        self.admission.set_alive(pass.host, is_alive);
        if is_alive {
            if let Some(newcomer) = self.losses.back(pass.host, self.now).flatten() {
                self.admission.retire(newcomer);
            }
            self.fill(pass.host);
        } else if !self.is_running {
            self.admission.leave(pass.host);
        } else if self.losses.offered_to(pass.host).is_some() {
            self.losses.decline(pass.host);
            self.admission.retire(pass.host);
        } else if let Some(places) = self.admission.places(pass.host) {
            self.losses.lose(places, self.now);
        }
    }

    fn fill(&mut self, host: HostId) {
        if self.admission.carries(host)
            && let Some((lost, _)) = self.losses.filled(host, self.now)
            && let Some(places) = self.admission.places(host)
        {
            self.admission.retire(lost.host);
            self.barrier.roster().replace(lost.host, places);
        }
    }

    /// The run goes on without what is lost.
    fn give_up(&mut self) {
        let lost: Vec<Places> = self.losses.places().collect();
        for places in lost {
            self.losses.forget(places.host);
            self.admission.retire(places.host);
            self.barrier.lose(places.host);
        }
    }

    fn restore(&mut self) {
        let next = Tti(self.tti);
        for places in self.losses.unasked(next) {
            let devices = vec![Checkpoint(Vec::new()); places.count as usize];
            let plan = None;
            self.losses.found(places.host, Resumption { next, plan, devices });
        }
    }

    fn hear(&mut self, input: &mut Unstructured<'_>) -> Result<()> {
        let host = HostId(input.int_in_range(0..=20)?);
        let device = DeviceId(input.int_in_range(0..=DEVICES)?);
        let tti = Tti(self.tti.saturating_sub(input.int_in_range(0..=2)?));
        let battery = Energy::from_micro(input.arbitrary::<u32>()?.into());
        let failure = Failure {
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
                let answer = Answer::Done {
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
                self.barrier.answer(host, Answer::NotWoken { device, tti, outcome });
            }
            3 => {
                let ledgers = Vec::new();
                self.barrier.answer(host, Answer::Final { host, ledgers });
            }
            _ => {
                let length = input.int_in_range(0..=64)?;
                if let Ok(answer) = codec::decode::<Answer>(input.bytes(length)?) {
                    self.barrier.answer(host, answer);
                }
            }
        }
        Ok(())
    }

    /// Every host that carries devices says that nothing has happened: that must be enough.
    fn answer_quietly(&mut self) {
        let tti = Tti(self.tti);
        for host in self.barrier.waiting() {
            let answer = Answer::Done {
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
                    .expect_grant(Tti(books.tti), input.arbitrary()?, Asked::default());
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
        let waiting = books.barrier.waiting();
        let is_early = books.barrier.is_complete() && open != Open::Wake && !waiting.is_empty();
        assert!(!is_early, "{waiting:?} have not answered");
        if books.barrier.is_complete() {
            match open {
                Open::Nothing => {}
                Open::Grant => drop(books.barrier.take_gathered()),
                Open::Wake => drop(books.barrier.take_outcome()),
                Open::Ledgers => drop(books.barrier.take_ledgers()),
            }
            open = Open::Nothing;
        }
    }
    Ok(())
}

fuzz_target!(|data: &[u8]| {
    // A fuzzer that has nothing more to say has said enough.
    let _done = play(&mut Unstructured::new(data));
});
