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
struct HostRecords {
    admission: Admission,
    barrier: Barrier,
    lost_hosts: LostHosts,
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

impl HostRecords {
    fn new(waits: bool) -> Self {
        let set = Override::parse(&format!("devices={DEVICES}")).expect("an override");
        let scenario = load("quick", &[set]).expect("a preset").scenario;
        let deployment = Deployment::new(&scenario);
        Self {
            admission: Admission::new(DEVICES),
            barrier: Barrier::new(Roster::new(deployment.devices, scenario.sensing.psi)),
            lost_hosts: LostHosts::default(),
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
            requested_at: self.now,
        })
    }

    fn add_credential(&mut self, assignment: Assignment, token: Secret) {
        let pass = HostCredential {
            host: assignment.host,
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
            if let Some((lost, _)) = self.lost_hosts.find_takeover(newcomer.count) {
                let assignment = self.admission.take_over(newcomer, lost);
                self.lost_hosts.reserve(lost.host, assignment.host);
                self.add_credential(assignment, token);
            }
        } else if let Some(assignment) = self.admission.admit(newcomer) {
            self.add_credential(assignment, token);
        }
        Ok(())
    }

    /// Starts the run when all hosts are ready.
    fn begin(&mut self) {
        if let Some(hosts) = self.admission.assignments_if_all_active().filter(|_| !self.is_running) {
            let mut has_owner = vec![false; DEVICES as usize];
            for assignment in &hosts {
                for device in assignment.first.0..=assignment.last().0 {
                    assert!(!std::mem::replace(&mut has_owner[device as usize], true), "two hosts own a device");
                }
            }
            assert!(has_owner.iter().all(|is_owned| *is_owned));
            self.barrier.roster_mut().set_hosts(hosts);
            self.is_running = true;
        }
    }

    fn alive(&mut self, pass: HostCredential, is_alive: bool) {
        if !self.admission.is_valid(pass) {
            return;
        }
        self.admission.set_alive(pass.host, is_alive);
        if is_alive {
            if let Some(newcomer) = self.lost_hosts.end_loss(pass.host, self.now).flatten() {
                self.admission.revoke(newcomer);
            }
            self.fill(pass.host);
        } else if !self.is_running {
            self.admission.free_host(pass.host);
        } else if self.lost_hosts.reservation_of(pass.host).is_some() {
            self.lost_hosts.cancel_reservation(pass.host);
            self.admission.revoke(pass.host);
        } else if let Some(assignment) = self.admission.assignment(pass.host) {
            self.lost_hosts.add(assignment, self.now);
        }
    }

    fn fill(&mut self, host: HostId) {
        if self.admission.is_active(host)
            && let Some((lost, _)) = self.lost_hosts.complete_takeover(host, self.now)
            && let Some(assignment) = self.admission.assignment(host)
        {
            self.admission.revoke(lost.host);
            self.barrier.roster_mut().replace(lost.host, assignment);
        }
    }

    /// Continues the run without the devices of lost hosts.
    fn remove_lost_hosts(&mut self) {
        let lost: Vec<Assignment> = self.lost_hosts.assignments().collect();
        for assignment in lost {
            self.lost_hosts.drop_host(assignment.host);
            self.admission.revoke(assignment.host);
            self.barrier.remove_host(assignment.host);
        }
    }

    fn restore(&mut self) {
        let next = Tti(self.tti);
        for assignment in self.lost_hosts.request_replays(next) {
            let devices = vec![DeviceCheckpoint(Vec::new()); assignment.count as usize];
            let at = ResumePoint { next, plan_from: None };
            self.lost_hosts.set_checkpoint(assignment.host, HostCheckpoint { at, devices });
        }
    }

    fn receive_message(&mut self, input: &mut Unstructured<'_>) -> Result<()> {
        let host = HostId(input.int_in_range(0..=20)?);
        let device = DeviceId(input.int_in_range(0..=DEVICES)?);
        let tti = Tti(self.tti.saturating_sub(input.int_in_range(0..=2)?));
        let battery = Energy::from_micro(input.arbitrary::<u32>()?.into());
        let failure = FailedTransmission {
            device,
            drained_energy: battery,
        };
        match input.int_in_range(0..=4)? {
            0 => {
                let report = Report {
                    device,
                    tti,
                    information: input.arbitrary()?,
                    battery,
                };
                self.barrier.receive_report(host, report);
            }
            1 => {
                let answer = HostAnswer::GrantDone {
                    host,
                    tti,
                    reports: input.arbitrary()?,
                    failures: if input.arbitrary()? { vec![failure] } else { Vec::new() },
                    totals: None,
                    views: None,
                };
                self.barrier.receive_answer(host, answer);
            }
            2 => {
                let outcome = match input.int_in_range(0..=2)? {
                    0 => WakeOutcome::Missed,
                    1 => WakeOutcome::Failed(failure),
                    _ => WakeOutcome::Late {
                        spent: battery,
                        powered: input.arbitrary()?,
                    },
                };
                self.barrier.receive_answer(host, HostAnswer::NotWoken { device, tti, outcome });
            }
            3 => {
                let ledgers = Vec::new();
                self.barrier.receive_answer(host, HostAnswer::Ledgers { host, ledgers });
            }
            _ => {
                let length = input.int_in_range(0..=64)?;
                if let Ok(answer) = codec::decode::<HostAnswer>(input.bytes(length)?) {
                    self.barrier.receive_answer(host, answer);
                }
            }
        }
        Ok(())
    }

    /// Has every host with devices answer that nothing happened; this must complete the barrier.
    fn answer_quietly(&mut self) {
        let tti = Tti(self.tti);
        for host in self.barrier.missing_hosts() {
            let answer = HostAnswer::GrantDone {
                host,
                tti,
                reports: 0,
                failures: Vec::new(),
                totals: None,
                views: None,
            };
            self.barrier.receive_answer(host, answer);
        }
    }
}

fn play(input: &mut Unstructured<'_>) -> Result<()> {
    let mut records = HostRecords::new(input.arbitrary()?);
    let mut open = Open::Nothing;
    while !input.is_empty() {
        records.now += Duration::from_millis(100);
        let pass = |records: &HostRecords, at: usize| records.passes.get(at % records.passes.len().max(1)).copied();
        match input.int_in_range(0..=11)? {
            0 => records.join(input)?,
            1 => {
                if let Some(pass) = pass(&records, input.arbitrary()?)
                    && records.admission.mark_ready(pass)
                {
                    records.fill(pass.host);
                }
            }
            2 | 3 => {
                if let Some(pass) = pass(&records, input.arbitrary()?) {
                    records.alive(pass, input.ratio(3, 4)?);
                }
            }
            4 => records.begin(),
            5 if !records.waits => records.remove_lost_hosts(),
            6 if records.waits => records.restore(),
            7 if records.is_running && open == Open::Nothing => {
                records.tti += 1;
                records
                    .barrier
                    .expect_grant(Tti(records.tti), input.arbitrary()?, GrantOptions::default());
                open = Open::Grant;
            }
            8 if records.is_running && open == Open::Nothing => {
                let device = DeviceId(input.int_in_range(0..=DEVICES - 1)?);
                records.barrier.expect_wake(Tti(records.tti), device);
                open = Open::Wake;
            }
            9 if records.is_running && open == Open::Nothing => {
                records.barrier.expect_ledgers();
                open = Open::Ledgers;
            }
            10 => {
                if open == Open::Grant {
                    records.answer_quietly();
                }
            }
            _ => records.receive_message(input)?,
        }
        let missing = records.barrier.missing_hosts();
        let is_early = records.barrier.is_complete() && open != Open::Wake && !missing.is_empty();
        assert!(!is_early, "{missing:?} have not answered");
        if records.barrier.is_complete() {
            match open {
                Open::Nothing => {}
                Open::Grant => drop(records.barrier.take_grant_result()),
                Open::Wake => drop(records.barrier.take_wake_outcome()),
                Open::Ledgers => drop(records.barrier.take_ledgers()),
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
