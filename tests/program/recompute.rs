//! Compares the metrics of runs with `tests/recompute/recompute.py`, which computes them from the tables of the run
//! folder and shares no code with the program. A new metric needs its formula there. The script prints `metrics are the
//! same` for each folder that agrees.

use std::path::Path;
use std::process::Command;

use reveille_tests::machine::skip_except_in_ci;
use reveille_tests::process::TestFolder;

/// Returns the options of the runs: all policies, then scarce energy, few events, bursts and a run without warm-up. The
/// script does not support radio faults.
fn run_options() -> Vec<String> {
    let policies = reveille_bs::policy::registry::names();
    let all_policies = policies.map(|policy| format!("-p {policy} -n 30 -k 1500"));
    let special_cases = [
        "-s paper-literal -p knn -n 40 -k 1500 --set harvest.e_b=1",
        "-p adjusted -n 12 -k 900 --set energy.initial=0 --set policy.adjusted.pilot_ttis=400",
        "-p knn -n 20 -k 1200 --set energy.e_tx=45 --set bs.ranking=posterior",
        "-p knn -n 10 -k 300 --set events.alpha=0.0005",
        "-p knn -n 25 -k 1500 --set events.process=bursts --set events.duration_kind=geometric",
        "-p random -n 7 -k 400 --set warm_up=0",
    ];
    all_policies.chain(special_cases.map(str::to_owned)).collect()
}

#[test]
fn metrics_equal_a_recomputation_from_the_tables() {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/recompute/recompute.py");
    let tomllib_import = Command::new("python3").args(["-c", "import tomllib"]).status();
    if !tomllib_import.is_ok_and(|status| status.success()) {
        return skip_except_in_ci("metrics are not recomputed: python3 3.11 or later is missing");
    }
    let folder = TestFolder::new();
    let all_options = run_options();
    let mut recompute = Command::new("python3");
    recompute.arg(script);
    for (number, options) in all_options.iter().enumerate() {
        let finished = folder.run(&format!("run {options} --quiet --out run{number}"));
        assert!(finished.is_success(), "{options}: {finished}");
        recompute.arg(folder.join(&format!("run{number}")));
    }
    let output = recompute.output().expect("python3 starts");
    let text = String::from_utf8_lossy(&output.stdout);
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}\n{error}");
    assert_eq!(
        text.matches("metrics are the same").count(),
        all_options.len(),
        "{text}"
    );
}
