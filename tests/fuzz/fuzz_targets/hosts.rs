//! Fuzzes the base station's host records (`Admission`, `Barrier`, `LostHosts` and `Roster` in `bs/src/server/`): hosts
//! join, get ready, leave, return, send expected and unexpected messages, and are replaced or removed. The records do
//! not panic, each device has one host when the run starts, and a barrier for a grant or ledgers is complete only with
//! all answers. The order of the draws defines the meaning of a corpus file.
//!
//! [`HostRecords`] repeats how `join`, `subscriptions`, `failure_detection` and `run_loop` of the base station call the
//! records: change both. Not exercised: hosts that ask for a range, hosts that are late to become ready, the
//! credentials of messages, and requests for totals or views. tests/fuzz/README.md shows how to run the target.

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
    DeviceCheckpoint, FailedTransmission, HostAnswer, HostCheckpoint, Report, ResumePoint, UnableDetectors, WakeOutcome,
};
use reveille_common::secret::{HostCredential, Secret};
use reveille_common::units::Energy;

const DEVICES: u32 = 12;

/// The base station's host records, driven by the fuzzer.
struct HostRecords {
    admission: Admission,
    barrier: Barrier,
    lost_hosts: LostHosts,
    /// Credentials of all hosts that were ever admitted, revoked ones too.
    credentials: Vec<HostCredential>,
    is_running: bool,
    /// Otherwise the run continues without the devices of lost hosts.
    waits_for_lost_hosts: bool,
    now: Instant,
    /// The last granted TTI.
    tti: u64,
}

/// Request whose answers the barrier collects.
#[derive(Clone, Copy, PartialEq)]
enum OpenRequest {
    None,
    Grant,
    Wake,
    Ledgers,
}

impl HostRecords {
    fn new(waits_for_lost_hosts: bool) -> Self {
        let device_count = Override::parse(&format!("devices={DEVICES}")).expect("an override");
        let scenario = load("quick", &[device_count]).expect("a preset").scenario;
        let deployment = Deployment::new(&scenario);
        Self {
            admission: Admission::new(DEVICES),
            barrier: Barrier::new(Roster::new(deployment.devices, scenario.sensing.psi)),
            lost_hosts: LostHosts::default(),
            credentials: Vec::new(),
            is_running: false,
            waits_for_lost_hosts,
            now: Instant::now(),
            tti: 0,
        }
    }

    fn draw_newcomer(&self, input: &mut Unstructured<'_>) -> Result<JoiningHost> {
        Ok(JoiningHost {
            // Few values, so that join requests are repeated.
            nonce: u64::from(input.arbitrary::<u8>()?),
            token: Secret::new(input.arbitrary()?),
            name: "a host".to_owned(),
            offered_devices: input.int_in_range(0..=2 * DEVICES)?,
            requested_at: self.now,
        })
    }

    /// Draws one of the credentials; `None` before the first admission.
    fn draw_credential(&self, input: &mut Unstructured<'_>) -> Result<Option<HostCredential>> {
        let index: usize = input.arbitrary()?;
        Ok(self.credentials.get(index % self.credentials.len().max(1)).copied())
    }

    fn add_credential(&mut self, assignment: Assignment, token: Secret) {
        let credential = HostCredential {
            host: assignment.host,
            token,
        };
        assert!(self.admission.is_valid(credential));
        self.credentials.push(credential);
    }

    /// Handles a join request.
    fn join(&mut self, input: &mut Unstructured<'_>) -> Result<()> {
        let newcomer = self.draw_newcomer(input)?;
        let token = newcomer.token;
        if self.admission.find_by_nonce(newcomer.nonce).is_some() {
            return Ok(());
        }
        if self.is_running {
            if !self.waits_for_lost_hosts {
                return Ok(());
            }
            if let Some((lost, _)) = self.lost_hosts.find_takeover(newcomer.offered_devices) {
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
    fn start_run(&mut self) {
        if let Some(assignments) = self.admission.assignments_if_all_active().filter(|_| !self.is_running) {
            let mut has_owner = vec![false; DEVICES as usize];
            for assignment in &assignments {
                for device in assignment.first.0..=assignment.last().0 {
                    assert!(!has_owner[device as usize], "two hosts own device {device}");
                    has_owner[device as usize] = true;
                }
            }
            assert!(has_owner.iter().all(|is_owned| *is_owned), "a device has no host");
            self.barrier.roster_mut().set_hosts(assignments);
            self.is_running = true;
        }
    }

    /// Handles a host that appears on the bus or disappears from it.
    fn set_alive(&mut self, credential: HostCredential, is_alive: bool) {
        if !self.admission.is_valid(credential) {
            return;
        }
        let host = credential.host;
        self.admission.set_alive(host, is_alive);
        if is_alive {
            if let Some(newcomer) = self.lost_hosts.end_loss(host, self.now).flatten() {
                self.admission.revoke(newcomer);
            }
            self.complete_takeover(host);
        } else if !self.is_running {
            self.admission.free_host(host);
        } else if self.lost_hosts.reservation_of(host).is_some() {
            self.lost_hosts.cancel_reservation(host);
            self.admission.revoke(host);
        } else if let Some(assignment) = self.admission.assignment(host) {
            self.lost_hosts.add(assignment, self.admission.host_name(host), self.now);
        }
    }

    /// Assigns the devices of a lost host to `host`, if they are reserved for it and it is active.
    fn complete_takeover(&mut self, host: HostId) {
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
        let lost_assignments: Vec<Assignment> = self.lost_hosts.assignments().collect();
        for assignment in lost_assignments {
            self.lost_hosts.drop_host(assignment.host);
            self.admission.revoke(assignment.host);
            self.barrier.remove_host(assignment.host);
        }
    }

    /// Provides the checkpoints of lost hosts, as a replay would.
    fn restore_checkpoints(&mut self) {
        let next = Tti(self.tti);
        for assignment in self.lost_hosts.request_replays(next) {
            let devices = vec![DeviceCheckpoint(Vec::new()); assignment.count as usize];
            let at = ResumePoint { next, plan_from: None };
            self.lost_hosts
                .set_checkpoint(assignment.host, HostCheckpoint { at, devices });
        }
    }

    /// Sends a report or an answer from any host to the barrier.
    fn receive_message(&mut self, input: &mut Unstructured<'_>) -> Result<()> {
        // Also hosts, a device and TTIs that do not exist.
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
                    unable: UnableDetectors {
                        unpowered: input.arbitrary()?,
                        failed: input.arbitrary()?,
                    },
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
                self.barrier
                    .receive_answer(host, HostAnswer::NoReport { device, tti, outcome });
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

    /// Has every host that has not answered the grant answer that nothing happened. This completes the barrier, unless
    /// an earlier answer announced reports that have not arrived.
    fn answer_quietly(&mut self) {
        let tti = Tti(self.tti);
        for host in self.barrier.missing_hosts() {
            let answer = HostAnswer::GrantDone {
                host,
                tti,
                reports: 0,
                failures: Vec::new(),
                unable: UnableDetectors::default(),
                totals: None,
                views: None,
            };
            self.barrier.receive_answer(host, answer);
        }
    }
}

fn play(input: &mut Unstructured<'_>) -> Result<()> {
    let mut records = HostRecords::new(input.arbitrary()?);
    let mut open_request = OpenRequest::None;
    while !input.is_empty() {
        records.now += Duration::from_millis(100);
        match input.int_in_range(0..=11)? {
            0 => records.join(input)?,
            1 => {
                if let Some(credential) = records.draw_credential(input)?
                    && records.admission.mark_ready(credential)
                {
                    records.complete_takeover(credential.host);
                }
            }
            2 | 3 => {
                if let Some(credential) = records.draw_credential(input)? {
                    records.set_alive(credential, input.ratio(3, 4)?);
                }
            }
            4 => records.start_run(),
            5 if !records.waits_for_lost_hosts => records.remove_lost_hosts(),
            6 if records.waits_for_lost_hosts => records.restore_checkpoints(),
            7 if records.is_running && open_request == OpenRequest::None => {
                records.tti += 1;
                records
                    .barrier
                    .expect_grant(Tti(records.tti), input.arbitrary()?, GrantOptions::default());
                open_request = OpenRequest::Grant;
            }
            8 if records.is_running && open_request == OpenRequest::None => {
                let device = DeviceId(input.int_in_range(0..=DEVICES - 1)?);
                records.barrier.expect_wake(Tti(records.tti), device);
                open_request = OpenRequest::Wake;
            }
            9 if records.is_running && open_request == OpenRequest::None => {
                records.barrier.expect_ledgers();
                open_request = OpenRequest::Ledgers;
            }
            10 => {
                if open_request == OpenRequest::Grant {
                    records.answer_quietly();
                }
            }
            _ => records.receive_message(input)?,
        }
        let missing_hosts = records.barrier.missing_hosts();
        // For a wake-up, `missing_hosts` names the owner of the device even after its outcome.
        let is_early = records.barrier.is_complete() && open_request != OpenRequest::Wake && !missing_hosts.is_empty();
        assert!(
            !is_early,
            "the barrier is complete without the answers of {missing_hosts:?}"
        );
        if records.barrier.is_complete() {
            match open_request {
                OpenRequest::None => {}
                OpenRequest::Grant => drop(records.barrier.take_grant_result()),
                OpenRequest::Wake => drop(records.barrier.take_wake_outcome()),
                OpenRequest::Ledgers => drop(records.barrier.take_ledgers()),
            }
            open_request = OpenRequest::None;
        }
    }
    Ok(())
}

fuzz_target!(|data: &[u8]| {
    // Running out of fuzzer input ends the case.
    let _result = play(&mut Unstructured::new(data));
});
