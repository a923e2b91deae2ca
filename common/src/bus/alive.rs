//! Who is there: liveliness tokens.

use std::time::Duration;

use zenoh::Wait;
use zenoh::liveliness::LivelinessToken;
use zenoh::sample::{Sample, SampleKind};

use super::{Bus, BusError, Declared};
use crate::keys::Keys;

impl Bus {
    /// Shows others that this session lives, until dropped or lost.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn declare_alive(&self, key: String) -> Result<Declared, BusError> {
        let token: LivelinessToken = self.session.liveliness().declare_token(key).wait()?;
        Ok(Declared::new(token))
    }

    /// Calls `handle` with the key of each token that matches `key`, and whether it came or went.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn watch_alive<F>(&self, key: String, handle: F) -> Result<Declared, BusError>
    where
        F: Fn(&str, bool) + Send + Sync + 'static,
    {
        let on_sample = move |sample: Sample| handle(sample.key_expr().as_str(), sample.kind() == SampleKind::Put);
        Ok(Declared::new(
            self.session
                .liveliness()
                .declare_subscriber(key)
                .history(true)
                .callback(on_sample)
                .wait()?,
        ))
    }

    /// The names of the runs whose BS lives behind this session.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub async fn runs(&self, patience: Duration) -> Result<Vec<String>, BusError> {
        let replies = self.session.liveliness().get(Keys::any_bs()).timeout(patience).await?;
        let mut runs = Vec::new();
        while let Ok(reply) = replies.recv_async().await {
            if let Ok(sample) = reply.result() {
                runs.extend(sample.key_expr().as_str().split('/').nth(1).map(str::to_owned));
            }
        }
        runs.sort();
        Ok(runs)
    }

    /// How many hosts of this run live behind this session.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub async fn alive_hosts(&self) -> Result<u32, BusError> {
        let replies = self.session.liveliness().get(self.keys.all_alive()).await?;
        let mut hosts = 0;
        while replies.recv_async().await.is_ok() {
            hosts += 1;
        }
        Ok(hosts)
    }

    /// That nobody serves this run here, with the names of those that are served.
    pub async fn no_run(&self) -> BusError {
        let runs = self.runs(Duration::from_secs(1)).await.unwrap_or_default();
        let hint = if runs.is_empty() {
            "No base station of any run lives there".to_owned()
        } else {
            format!("Runs there: {}", runs.join(", "))
        };
        BusError::NoRun {
            endpoint: self.endpoint.to_string(),
            run: self.keys.run().clone(),
            hint,
        }
    }
}
