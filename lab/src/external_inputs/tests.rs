//! Tests of the input log: round trips, old versions, and the error of each broken line. The scenario is the preset
//! `quick`: inputs name devices and TTIs of it. The fuzz target `files` parses random logs.

use reveille_bs::scenario::load;
use reveille_common::ids::{DeviceId, Tti};

use super::*;

fn removal(first: u32, count: u32, tti: u64) -> DeviceRemoval {
    DeviceRemoval {
        first: DeviceId(first),
        count,
        tti: Tti(tti),
        wake_ups: None,
    }
}

/// Writes a log of these inputs with a truncated last line, and parses it.
fn write_and_parse(inputs: &[ExternalInput]) -> Result<ExternalInputs, InputLogError> {
    let scenario = load("quick", &[]).expect("a preset").scenario;
    let lines: String = inputs.iter().map(input_line).collect();
    parse(&format!("{}{lines}{{\"outage\":", first_line(&scenario)), &scenario)
}

fn plan_decision(tti: u64, plan: Plan, next: u64) -> RecordedDecision {
    let next = Tti(next);
    let decision = Decision::Plan(PlanDecision { plan, next });
    RecordedDecision {
        tti: Tti(tti),
        decision,
    }
}

fn wake_decision(tti: u64, devices: &[u32]) -> RecordedDecision {
    let decision = Decision::Wake(devices.iter().copied().map(DeviceId).collect());
    RecordedDecision {
        tti: Tti(tti),
        decision,
    }
}

fn test_actions() -> Vec<OperatorAction> {
    let devices = DeviceRange {
        first: DeviceId(3),
        count: 4,
    };
    let changes = [
        (9, Change::Fail(devices)),
        (4, Change::AddEnergy(devices, Energy::from_micro(71_429))),
        (9, Change::Revive(devices)),
        (70, Change::Set(Setting::EventRate, 0.1 + 0.2)),
    ];
    changes
        .map(|(tti, change)| OperatorAction { tti: Tti(tti), change })
        .to_vec()
}

#[test]
fn the_line_of_an_action_names_its_fields() {
    let lines: String = test_actions()
        .into_iter()
        .map(|action| input_line(&ExternalInput::Action(action)))
        .collect();
    assert_eq!(
        lines,
        "{\"fail\":{\"tti\":9,\"first\":3,\"count\":4}}\n\
         {\"energy\":{\"tti\":4,\"first\":3,\"count\":4,\"micro\":71429}}\n\
         {\"revive\":{\"tti\":9,\"first\":3,\"count\":4}}\n\
         {\"set\":{\"tti\":70,\"field\":\"events.alpha\",\"value\":0.30000000000000004}}\n"
    );
}

#[test]
fn an_impossible_action_is_refused_with_the_reason() {
    let scenario = load("quick", &[]).expect("a preset").scenario;
    let cases = [
        ("{\"fail\":{\"tti\":1,\"first\":0,\"count\":0}}", "not in the run"),
        (
            "{\"revive\":{\"tti\":1,\"first\":4294967295,\"count\":2}}",
            "not in the run",
        ),
        (
            "{\"energy\":{\"tti\":1,\"first\":0,\"count\":1,\"micro\":0}}",
            "no effect",
        ),
        (
            "{\"energy\":{\"tti\":1,\"first\":0,\"count\":1,\"micro\":18446744073709551615}}",
            "at most",
        ),
        (
            "{\"fail\":{\"tti\":18446744073709551615,\"first\":0,\"count\":1}}",
            "is not in the run",
        ),
        (
            "{\"set\":{\"tti\":1,\"field\":\"events.alpha\",\"value\":2}}",
            "must be above 0",
        ),
        (
            "{\"set\":{\"tti\":1,\"field\":\"seed\",\"value\":2}}",
            "seed cannot change during a run",
        ),
    ];
    for (text, cause) in cases {
        let error = parse(&(first_line(&scenario) + text + "\n"), &scenario)
            .expect_err(text)
            .to_string();
        assert!(
            error.starts_with("line 2: ") && error.contains(cause),
            "{text}: {error}"
        );
    }
}

/// Returns a plan for the devices of the preset `quick`, in which device `j` alone senses.
fn plan_of_one(j: u32) -> Plan {
    let devices = load("quick", &[]).expect("a preset").scenario.run.devices;
    Plan::from_devices(devices as usize, &[DeviceId(j)])
}

#[test]
fn a_log_round_trips_up_to_its_last_complete_line() {
    let devices = load("quick", &[]).expect("a preset").scenario.run.devices as usize;
    let inputs = ExternalInputs {
        removals: vec![removal(3, 2, 5), removal(0, 3, 5), removal(9, 1, 80)],
        decisions: vec![
            plan_decision(0, plan_of_one(3), 1),
            wake_decision(0, &[7, 2]),
            wake_decision(0, &[]),
            plan_decision(1, Plan::Periodic(vec![DutyCycle::SENSING; devices]), u64::MAX),
            wake_decision(60, &[1]),
        ],
        actions: test_actions(),
    };
    let all_inputs: Vec<ExternalInput> = inputs.iter().collect();
    assert_eq!(write_and_parse(&all_inputs).expect("a log"), inputs);
    let scenario = load("quick", &[]).expect("a preset").scenario;
    let text = first_line(&scenario) + &all_inputs.iter().map(input_line).collect::<String>();
    for piece_bytes in [1, 7, 60, 4000] {
        let (mut parser, mut read_bytes, mut available_bytes) = (InputLogParser::default(), 0, 0);
        while read_bytes < text.len() {
            available_bytes = text.len().min(available_bytes + piece_bytes);
            read_bytes += parser
                .read(&text[read_bytes..available_bytes], &scenario)
                .expect("a log");
        }
        assert_eq!(parser.inputs(), &inputs, "{piece_bytes} bytes at a time");
    }
    assert_eq!(write_and_parse(&[]).expect("a log"), ExternalInputs::default());
}

#[test]
fn an_impossible_log_is_refused_with_the_reason() {
    let impossible_removals = [
        vec![removal(0, 0, 5)],
        vec![removal(3, 2, 5), removal(0, 0, 6)],
        vec![removal(u32::MAX, 2, 5)],
        vec![removal(0, 1, u64::MAX)],
        vec![removal(3, 2, 5), removal(4, 1, 9)],
        vec![removal(3, 2, 5), removal(0, 1, 4)],
    ];
    for removals in impossible_removals {
        let removals: Vec<ExternalInput> = removals.into_iter().map(ExternalInput::Removal).collect();
        let error = write_and_parse(&removals).expect_err("impossible");
        assert!(matches!(error, InputLogError::Removal(_)), "{error}");
    }
    let first_plan = || plan_decision(0, plan_of_one(3), 1);
    let impossible_decisions = [
        vec![plan_decision(1, plan_of_one(3), 2)],
        vec![wake_decision(0, &[1])],
        vec![first_plan(), plan_decision(0, plan_of_one(3), 1)],
        vec![first_plan(), plan_decision(1, plan_of_one(3), 1)],
        vec![
            first_plan(),
            wake_decision(1, &[1]),
            plan_decision(1, plan_of_one(3), 2),
        ],
        vec![first_plan(), wake_decision(0, &[u32::MAX])],
        vec![
            first_plan(),
            plan_decision(1, Plan::Periodic(vec![DutyCycle::SENSING]), 2),
        ],
        vec![first_plan(), plan_decision(u64::MAX, plan_of_one(3), 2)],
    ];
    for decisions in impossible_decisions {
        let decisions: Vec<ExternalInput> = decisions.into_iter().map(ExternalInput::Decision).collect();
        let error = write_and_parse(&decisions).expect_err("impossible");
        assert!(matches!(error, InputLogError::Decision(_)), "{error}");
    }
}

#[test]
fn an_invalid_text_is_refused_with_its_place() {
    let scenario = load("quick", &[]).expect("a preset").scenario;
    let error_of = |text: &str| parse(text, &scenario).expect_err("no log of this run");
    assert_eq!(
        error_of("{\"wake\":{\"tti\":true}}\n").to_string(),
        "line 1, column 19: invalid input log entry: invalid type: boolean `true`, expected u64; use the \
         inputs.log of a run folder"
    );
    assert!(matches!(
        error_of(&input_line(&ExternalInput::Removal(removal(0, 1, 1)))),
        InputLogError::MissingFirstLine(1)
    ));
    // Without a newline, only the start of a first line is the log of a killed run.
    for text in ["garbage", "\0\u{1}", "{\"inputs\":{\"version\":2}}", " "] {
        let error = error_of(text);
        assert!(
            matches!(error, InputLogError::Line { line: 1, .. }),
            "{text:?}: {error}"
        );
    }
    let removal_line = input_line(&ExternalInput::Removal(removal(0, 1, 1)));
    assert!(matches!(
        error_of(removal_line.trim_end()),
        InputLogError::MissingFirstLine(1)
    ));
    for version in 1..=VERSION {
        let first = first_line_of(version, &scenario);
        for length in [0, 1, 9, first.len() - 1, first.len()] {
            let inputs = parse(&first[..length], &scenario).expect("a truncated log");
            assert_eq!(inputs, ExternalInputs::default(), "{length} bytes");
        }
    }
}

#[test]
fn a_second_first_line_and_logs_of_other_runs_and_versions_are_refused() {
    let scenario = load("quick", &[]).expect("a preset").scenario;
    let error_of = |text: &str| parse(text, &scenario).expect_err("no log of this run");
    let removal_line = input_line(&ExternalInput::Removal(removal(0, 1, 1)));
    let text_with_torn_line = first_line(&scenario) + &removal_line + "garbage";
    assert_eq!(
        parse(&text_with_torn_line, &scenario).expect("a log").removals,
        [removal(0, 1, 1)]
    );
    let text_with_two_first_lines = first_line(&scenario) + &removal_line + &first_line(&scenario);
    assert!(matches!(
        error_of(&text_with_two_first_lines),
        InputLogError::SecondFirstLine(3)
    ));
    let first_line_of_version_1 = first_line_of(1, &scenario);
    assert_eq!(
        parse(&(first_line_of_version_1.clone() + &removal_line), &scenario)
            .expect("a log")
            .removals,
        [removal(0, 1, 1)]
    );
    for decision in [plan_decision(0, plan_of_one(3), 1), wake_decision(0, &[1])] {
        let with_decision =
            first_line_of_version_1.clone() + &removal_line + &input_line(&ExternalInput::Decision(decision));
        assert!(matches!(error_of(&with_decision), InputLogError::DecisionInVersion1(3)));
    }
    let first_line_of_other_run =
        |version| format!("{{\"inputs\":{{\"version\":{version},\"scenario_hash\":\"00\"}}}}\n");
    assert!(matches!(
        error_of(&first_line_of_other_run(VERSION)),
        InputLogError::Scenario
    ));
    assert!(matches!(
        error_of(first_line_of_other_run(VERSION).trim_end()),
        InputLogError::Scenario
    ));
    assert!(matches!(
        error_of(&first_line_of_other_run(VERSION + 1)),
        InputLogError::Version
    ));
}
