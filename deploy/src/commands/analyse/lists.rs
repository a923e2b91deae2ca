//! Parsing of lists on the command line, and the scenarios built from them. Only the studies of `reveille analyse` use
//! it. Errors name the option: a function without a parameter `flag` serves one option, and repeats its name.

use anyhow::bail;
use reveille_bs::scenario::{Loaded, Override, Scenario, load};
use reveille_common::units::{Energy, MAX_UNITS};
use reveille_study::analysis::harvest::LambdaReading;

use crate::cli::StudyArgs;

/// Splits the list `text` given by `flag` at commas into items. Empty items are dropped. `example` is a valid list, for
/// the error.
///
/// # Errors
/// If the list is empty.
pub(super) fn split_list<'a>(flag: &str, text: &'a str, example: &str) -> anyhow::Result<Vec<&'a str>> {
    let words: Vec<&str> = text.split(',').map(str::trim).filter(|word| !word.is_empty()).collect();
    if words.is_empty() {
        bail!(
            "{flag} {text:?}: the list is empty, so there is nothing to study; give values separated by commas, for \
                example {flag} {example}"
        );
    }
    Ok(words)
}

/// Parses the numbers of the list `text` given by `flag`.
///
/// # Errors
/// If the list is empty, or a word is not a finite number.
pub(super) fn parse_numbers(flag: &str, text: &str, example: &str) -> anyhow::Result<Vec<f64>> {
    let parse = |word: &str| match word.parse::<f64>() {
        Ok(number) if number.is_finite() => Ok(number),
        Ok(_) | Err(_) => bail!(
            "{flag} {text}: `{word}` is not a finite number; give numbers separated by commas, for example {flag} \
             {example}"
        ),
    };
    split_list(flag, text, example)?.into_iter().map(parse).collect()
}

/// Parses the energies E_B of `--e-b`, units.
///
/// # Errors
/// If the list is empty, or a value is out of range.
pub(super) fn parse_energies(text: &str) -> anyhow::Result<Vec<Energy>> {
    let check = |units: f64| match Energy::from_units(units) {
        Some(energy) if energy > Energy::ZERO => Ok(energy),
        Some(_) | None => bail!("--e-b {text}: {units} must be above 0 and at most {MAX_UNITS} units an arrival"),
    };
    parse_numbers("--e-b", text, "1,5,10")?.into_iter().map(check).collect()
}

/// Parses the interpretations of λ as a probability in `--readings`. The error here and the help of the option repeat
/// the names in [`LambdaReading::ALL`].
///
/// # Errors
/// If the list is empty, or a reading is unknown.
pub(super) fn parse_readings(text: &str) -> anyhow::Result<Vec<LambdaReading>> {
    let find = |word: &str| match LambdaReading::ALL.into_iter().find(|r| r.name() == word) {
        Some(reading) => Ok(reading),
        None => bail!("--readings {text}: `{word}` is not a reading of λ; must be eq5 or exp-minus-lambda"),
    };
    split_list("--readings", text, "eq5")?.into_iter().map(find).collect()
}

/// Parses the duty cycles of `--duty` into pairs (t_on, t_DRX), TTIs.
///
/// # Errors
/// If the list is empty, or an entry is not of the form t_on/t_DRX.
pub(super) fn parse_duties(text: &str) -> anyhow::Result<Vec<(u32, u32)>> {
    let parse = |word: &str| {
        let pair = word
            .split_once('/')
            .and_then(|(on, drx)| Some((on.trim().parse().ok()?, drx.trim().parse().ok()?)));
        match pair {
            Some((t_on, t_drx)) if t_drx > 0 && t_on <= t_drx => Ok((t_on, t_drx)),
            Some((t_on, t_drx)) => bail!(
                "--duty {text}: t_on = {t_on} must be at most t_DRX = {t_drx}, and t_DRX at least 1, both in TTIs"
            ),
            None => bail!("--duty {text}: `{word}` must be t_on/t_DRX in TTIs, for example 1/8"),
        }
    };
    split_list("--duty", text, "1/2,1/8")?.into_iter().map(parse).collect()
}

/// Builds the scenario of `study` and logs its warnings. Each entry of `fields` has the option, the field and the
/// value; `None` keeps the field. A value overrides `--set` of the same field, and `--seed` does too.
///
/// # Errors
/// If the scenario is invalid; the message names the field and the option.
pub(super) fn build_scenario(study: &StudyArgs, fields: &[(&str, &str, Option<&str>)]) -> anyhow::Result<Scenario> {
    let mut overrides: Vec<Override> = study
        .set
        .iter()
        .map(|text| Override::parse(text))
        .collect::<Result<_, _>>()?;
    let seed_field = [("--seed", "seed", study.seed.as_deref())];
    for (flag, field, value) in seed_field.iter().chain(fields) {
        if let Some(value) = value {
            overrides.push(Override::from_flag(flag, field, value)?);
        }
    }
    let Loaded { scenario, warnings } = load(&study.scenario, &overrides)?;
    for warning in &warnings {
        tracing::warn!("{warning}");
    }
    Ok(scenario)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn valid_lists_are_parsed() {
        assert_eq!(parse_numbers("--lambda", "0.1, 2,", "1").expect("numbers"), [0.1, 2.0]);
        assert_eq!(parse_duties("1/2, 3/3").expect("duties"), [(1, 2), (3, 3)]);
        assert_eq!(
            parse_readings("exp-minus-lambda").expect("a reading"),
            [LambdaReading::ExpMinusLambda]
        );
        assert_eq!(parse_energies("0.5").expect("an energy"), [Energy::from_micro(500_000)]);
    }

    #[test]
    fn invalid_lists_are_refused_with_the_option_and_a_fix() {
        let assert_refused = |result: anyhow::Result<()>, cause: &str| {
            let message = result.expect_err(cause).to_string();
            assert!(message.contains(cause), "{message}");
        };
        assert_refused(
            parse_numbers("--lambda", " ,", "0.1").map(drop),
            "--lambda \" ,\": the list is empty",
        );
        assert_refused(
            parse_numbers("--lambda", "0.1,x", "0.1").map(drop),
            "`x` is not a finite number",
        );
        assert_refused(
            parse_numbers("--lambda", "nan", "0.1").map(drop),
            "`nan` is not a finite number",
        );
        assert_refused(parse_duties("3/2").map(drop), "t_on = 3 must be at most t_DRX = 2");
        assert_refused(parse_duties("0/0").map(drop), "t_DRX at least 1");
        assert_refused(parse_duties("8").map(drop), "must be t_on/t_DRX");
        assert_refused(parse_readings("eq6").map(drop), "must be eq5 or exp-minus-lambda");
        assert_refused(parse_energies("0").map(drop), "must be above 0");
    }
}
