//! Routers between device processes and the base station: a chain of two routers, lost processes behind it, a router
//! that is started again, and a base station that resumes its run. `tests/federation/` has routers on separate
//! machines.

use reveille_tests::process::{
    PATIENCE, Process, SummaryJson, TestFolder, assert_refused, free_endpoint, unique_run, wait_until,
};
use rustix::process::Signal;

/// A running router.
pub(crate) struct Router {
    process: Process,
    /// Endpoint on which it listens.
    pub(crate) endpoint: String,
}

impl Router {
    /// Starts a router of `run` that connects to `upstream`, and waits until it has reached the base station.
    pub(crate) fn start(folder: &TestFolder, run: &str, upstream: &str) -> Self {
        Self::start_at(folder, run, upstream, free_endpoint())
    }

    fn start_at(folder: &TestFolder, run: &str, upstream: &str, endpoint: String) -> Self {
        let process = folder.start(&format!("router --run {run} --connect {upstream} --listen {endpoint}"));
        process.wait_for_stderr("connected to run");
        Self { process, endpoint }
    }
}

/// A run of 30 devices with a router, a second router behind it, and devices behind each.
struct RoutedRun {
    folder: TestFolder,
    name: String,
    endpoint: String,
    bs: Process,
    routers: [Router; 2],
    devices: [Process; 2],
}

/// Options of the scenario, and a pace at which the run takes over 4 s.
const SCENARIO: &str = "-n 30 -k 1500";
const PACE: &str = "--pace 3ms";

impl RoutedRun {
    fn start(name: &str) -> Self {
        let (folder, name, endpoint) = (TestFolder::new(), unique_run(name), free_endpoint());
        let bs = folder.start(&format!(
            "bs {SCENARIO} {PACE} --out out --run {name} --listen {endpoint}"
        ));
        bs.wait_for_stderr("waiting for 30 devices");
        let first = Router::start(&folder, &name, &endpoint);
        let second = Router::start(&folder, &name, &first.endpoint);
        let devices = [&first, &second].map(|router| {
            let device = folder.start(&format!("device --run {name} --connect {} --count 15", router.endpoint));
            device.wait_for_stderr("joined");
            device
        });
        folder.wait_for_tti(&name, 20);
        Self {
            folder,
            name,
            endpoint,
            bs,
            routers: [first, second],
            devices,
        }
    }

    /// Waits for the end of the run, checks the digest, and ends the routers.
    fn finish(self) {
        let finished = self.bs.finish();
        assert!(finished.is_success(), "{finished}");
        let expected = self.folder.summary(&format!("run {SCENARIO}"));
        assert_eq!(SummaryJson::read(&self.folder.join("out")).digest(), expected.digest());
        for device in self.devices {
            let finished = device.finish();
            assert!(finished.is_success(), "{finished}");
        }
        for router in self.routers {
            router.process.signal(Signal::INT);
            let finished = router.process.finish();
            assert!(finished.is_success(), "{finished}");
        }
    }
}

/// The process behind both routers is killed; a third process, behind both too, takes over.
#[test]
fn a_killed_process_behind_two_routers_is_replaced() {
    let mut run = RoutedRun::start("chain");
    let second = &run.routers[1].endpoint;
    let status = run
        .folder
        .run(&format!("clock status --hosts --run {} --connect {second}", run.name));
    assert!(
        status.is_success() && status.stdout.contains("devices 15 to 29"),
        "{status}"
    );
    run.devices[1].signal(Signal::KILL);
    run.devices[1] = run
        .folder
        .start(&format!("device --run {} --connect {second}", run.name));
    run.bs.wait_for_stderr("had no host for");
    run.finish();
}

/// The devices behind a killed router are lost, and return with the router.
#[test]
fn devices_return_with_their_router() {
    let mut run = RoutedRun::start("cut");
    run.routers[1].process.signal(Signal::KILL);
    let connect = run.routers[0].endpoint.clone();
    wait_until("the status to show the loss", PATIENCE, || {
        let status = run.folder.clock(&run.name, "status --hosts");
        status.contains("lost").then_some(())
    });
    run.routers[1] = Router::start_at(&run.folder, &run.name, &connect, run.routers[1].endpoint.clone());
    run.bs.wait_for_stderr(" is back");
    run.finish();
}

/// A base station that resumes its run has another secret, which both routers fetch.
#[test]
fn routers_follow_a_resumed_base_station() {
    let mut run = RoutedRun::start("follow");
    wait_until("a resume mark", PATIENCE, || {
        run.folder.list("out").contains(&"resume.json".to_owned()).then_some(())
    });
    run.bs.signal(Signal::KILL);
    for router in &run.routers {
        router.process.wait_for_stderr("lost the base station");
    }
    run.bs = run.folder.start(&format!(
        "bs --resume out {PACE} --run {} --listen {}",
        run.name, run.endpoint
    ));
    for router in &run.routers {
        router.process.wait_for_stderr("was started again");
    }
    run.finish();
}

/// A run with a key admits only routers that show it.
#[test]
fn a_router_needs_the_key_of_the_run() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("key"), free_endpoint());
    let _bs = folder.start_waiting_bs(&run, &endpoint, "--key-file run.key");
    let router = format!("router --run {run} --connect {endpoint} --listen tcp/127.0.0.1:0");
    assert_refused(&folder.run(&router), 1, &["does not show the run's key"]);
    let admitted = folder.start(&format!("{router} --key-file run.key"));
    admitted.wait_for_stderr("connected to run");
}
