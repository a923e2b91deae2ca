//! Who is there: liveliness tokens.

use std::pin::Pin;
use std::time::Duration;

use zenoh::Wait;
use zenoh::liveliness::LivelinessToken;
use zenoh::sample::{Sample, SampleKind};

use super::{Bus, BusError, Declared};
use crate::keys::Keys;

/// Is told of a token that came or went.
type Handle = dyn Fn(&str, bool) + Send + Sync;
/// Keys of liveliness tokens.
type Tokens<'b> = Pin<Box<dyn Future<Output = Result<Vec<Option<String>>, BusError>> + Send + 'b>>;

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
        self.watch_boxed(key, Box::new(handle))
    }

    /// The same, apart so that zenoh's part of it is compiled here and once.
    fn watch_boxed(&self, key: String, handle: Box<Handle>) -> Result<Declared, BusError> {
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
        let tokens = self.tokens(Keys::any_bs().to_owned(), Some(patience)).await?;
        let name = |key: &String| key.split('/').nth(1).map(str::to_owned);
        let mut runs: Vec<String> = tokens.iter().flatten().filter_map(name).collect();
        runs.sort();
        Ok(runs)
    }

    /// How many hosts of this run live behind this session.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub async fn alive_hosts(&self) -> Result<u32, BusError> {
        Ok(self.tokens(self.keys.all_alive(), None).await?.len() as u32)
    }

    /// The replies of those that match `key`, each with its key unless it is an error; boxed so that zenoh's part is
    /// compiled here and once.
    fn tokens(&self, key: String, patience: Option<Duration>) -> Tokens<'_> {
        Box::pin(async move {
            let question = self.session.liveliness().get(key);
            let question = match patience {
                Some(patience) => question.timeout(patience),
                None => question,
            };
            let replies = question.await?;
            let mut tokens = Vec::new();
            while let Ok(reply) = replies.recv_async().await {
                let sample = reply.result().ok();
                tokens.push(sample.map(|sample| sample.key_expr().as_str().to_owned()));
            }
            Ok(tokens)
        })
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
