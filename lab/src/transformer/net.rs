//! The model in the training framework: the same sums as in [`reveille_bs::policy::dt::model`], in differentiable form.
//! Change both: a test compares their outputs. Names and sizes of the tensors come from [`ModelShape::tensors`]; this
//! file repeats the names. A batch has C chunks with T TTIs of N devices, and F features per token.

use std::collections::BTreeMap;

use candle_core::{D, DType, Device, Result, Tensor, Var};
use candle_nn::ops::softmax;
use reveille_bs::policy::dt::model::infer::{MIN_FEATURE, OUTPUT_LIMIT};
use reveille_bs::policy::dt::model::{ModelShape, NORM_EPSILON, OUTPUTS};
use reveille_common::rng::{Purpose, Stream};

/// The trainable weights of a model.
pub struct Net {
    shape: ModelShape,
    vars: BTreeMap<&'static str, Var>,
}

/// The outputs of a net for a batch.
pub struct Outputs {
    /// Logarithms by chunk, TTI, device and output, `[C, T, N, OUTPUTS]`.
    pub logs: Tensor,
    /// The logarithm of the price for each chunk and TTI, `[C, T]`. The policy also limits it.
    pub log_price: Tensor,
}

impl Net {
    /// Creates a net with weights drawn from `seed`. Its output weights are 0, so it expects events by α alone.
    ///
    /// # Errors
    /// If the framework fails.
    pub fn new(shape: ModelShape, seed: u64) -> Result<Self> {
        let mut vars = BTreeMap::new();
        for (id, (name, size)) in (0..).zip(shape.tensors()) {
            let count = size.iter().product();
            let mut stream = Stream::new(seed, Purpose::Training, id);
            // The names of `ModelShape::tensors` decide the initial values: another name changes trained models.
            let values: Vec<f32> = if name.ends_with("norm") {
                vec![1.0; count]
            } else if name.ends_with("bias") || name == "head.weight" {
                vec![0.0; count]
            } else {
                // Uniform on ±√(3/fan-in): a variance of 1/fan-in.
                let bound = (3.0 / size[0] as f64).sqrt();
                (0..count)
                    .map(|_| (bound * (2.0 * stream.unit() - 1.0)) as f32)
                    .collect()
            };
            vars.insert(name, Var::from_vec(values, size, &Device::Cpu)?);
        }
        Ok(Self { shape, vars })
    }

    /// Converts the weights to numbers of another type.
    #[cfg(test)]
    pub(super) fn to_dtype(&self, dtype: DType) -> Result<Self> {
        let var = |(name, var): (&&'static str, &Var)| -> Result<_> {
            Ok((*name, Var::from_tensor(&var.as_tensor().to_dtype(dtype)?)?))
        };
        Ok(Self {
            shape: self.shape,
            vars: self.vars.iter().map(var).collect::<Result<_>>()?,
        })
    }

    /// The weights by name, in a fixed order.
    pub(crate) const fn vars(&self) -> &BTreeMap<&'static str, Var> {
        &self.vars
    }

    /// The shape.
    pub const fn shape(&self) -> ModelShape {
        self.shape
    }

    fn var(&self, name: &str) -> &Tensor {
        self.vars[name].as_tensor()
    }

    /// Computes the outputs for `tokens`, `[C, T, N, F]`, with the `targets` of each chunk and TTI, `[C, T]`.
    ///
    /// # Errors
    /// If the tensors have other shapes.
    pub fn forward(&self, tokens: &Tensor, targets: &Tensor) -> Result<Outputs> {
        let (c, t, n, f) = tokens.dims4()?;
        let d = self.shape.width;
        let flat = tokens.reshape((c * t * n, f))?;
        let mut state = self.linear(&flat, "embed.weight", "embed.bias")?.relu()?;
        if self.shape.attends_to_past() {
            state = self.attend_in_time(&state, (c, t, n))?;
        }
        state = self.feed_forward(&state, "time")?;
        if self.shape.attends_to_devices {
            state = self.feed_forward(&self.attend_in_space(&state, (c, t, n))?, "space")?;
        }
        let normed = self.norm(&state, "head.norm")?;
        let raw_logs = self.linear(&normed, "head.weight", "head.bias")?;
        let limited = (raw_logs.clone() * f64::from(OUTPUT_LIMIT))?.div(&(raw_logs.abs()? + 1.0)?)?;
        // Detached: the price is learned from the other features without changing them.
        let pooled = normed.detach().reshape((c * t, n, d))?.mean(1)?;
        let price_input = Tensor::cat(&[&pooled, &targets.reshape((c * t, 1))?], 1)?;
        let price_hidden = self.linear(&price_input, "price.in.weight", "price.in.bias")?.relu()?;
        let log_price = self.linear(&price_hidden, "price.out.weight", "price.out.bias")?;
        Ok(Outputs {
            logs: limited.reshape((c, t, n, OUTPUTS))?,
            log_price: log_price.reshape((c, t))?,
        })
    }

    fn linear(&self, x: &Tensor, weight: &str, bias: &str) -> Result<Tensor> {
        x.matmul(self.var(weight))?.broadcast_add(self.var(bias))
    }

    /// Divides each row by its root mean square and multiplies it by the weight `scale`.
    fn norm(&self, x: &Tensor, scale: &str) -> Result<Tensor> {
        let mean_square = x.sqr()?.mean_keepdim(D::Minus1)?;
        let inverse_root = (mean_square + f64::from(NORM_EPSILON))?.sqrt()?.recip()?;
        x.broadcast_mul(&inverse_root)?.broadcast_mul(self.var(scale))
    }

    /// Adds the feed-forward layer whose weights are called `prefix.mix`.
    fn feed_forward(&self, x: &Tensor, prefix: &str) -> Result<Tensor> {
        let name = |part: &str| format!("{prefix}.mix.{part}");
        let inner = self.linear(&self.norm(x, &name("norm"))?, &name("in.weight"), &name("in.bias"))?;
        x + self.linear(&inner.relu()?, &name("out.weight"), &name("out.bias"))?
    }

    /// Applies the attention of each device to its last Z TTIs, to rows `[C·T·N, d]`.
    fn attend_in_time(&self, x: &Tensor, (c, t, n): (usize, usize, usize)) -> Result<Tensor> {
        let (heads, width) = (self.shape.heads, self.shape.head_width());
        let normed = self.norm(x, "time.norm")?;
        // [C·N, heads, T, width]
        let by_device = |name: &str| -> Result<Tensor> {
            let split = normed.matmul(self.var(name))?.reshape((c, t, n, heads, width))?;
            split
                .permute((0, 2, 3, 1, 4))?
                .reshape((c * n, heads, t, width))?
                .contiguous()
        };
        let (query, key, value) = (
            by_device("time.query")?,
            by_device("time.key")?,
            by_device("time.value")?,
        );
        let scale = 1.0 / (width as f64).sqrt();
        let scores = (query.matmul(&key.t()?.contiguous()?)? * scale)?.broadcast_add(&self.lag_bias(t)?)?;
        // Not `softmax_last_dim`, which has no backward pass.
        let gathered = softmax(&scores, D::Minus1)?.matmul(&value)?;
        let gathered = gathered.reshape((c, n, heads, t, width))?.permute((0, 3, 1, 2, 4))?;
        let gathered = gathered.contiguous()?.reshape((c * t * n, heads * width))?;
        x + gathered.matmul(self.var("time.out"))?
    }

    /// Returns the bias of the lag between two TTIs, `[heads, T, T]`; a TTI only attends to the last Z.
    fn lag_bias(&self, t: usize) -> Result<Tensor> {
        let (heads, z) = (self.shape.heads, self.shape.memory);
        let bias = self.var("time.bias");
        // A last column for all other lags, whose weight the softmax makes 0.
        let out_of_reach = Tensor::full(-1e9_f32, (heads, 1), &Device::Cpu)?.to_dtype(bias.dtype())?;
        let lags = Tensor::cat(&[bias, &out_of_reach], 1)?;
        let lag_column = |query_tti: usize, key_tti: usize| match query_tti.checked_sub(key_tti) {
            Some(lag) if lag < z => lag as u32,
            Some(_) | None => z as u32,
        };
        let indices: Vec<u32> = (0..t)
            .flat_map(|query_tti| (0..t).map(move |key_tti| lag_column(query_tti, key_tti)))
            .collect();
        let indices = Tensor::from_vec(indices, t * t, &Device::Cpu)?;
        lags.index_select(&indices, 1)?.reshape((heads, t, t))
    }

    /// Applies the linear attention of each device to all devices in the same TTI, to rows `[C·T·N, d]`.
    fn attend_in_space(&self, x: &Tensor, (c, t, n): (usize, usize, usize)) -> Result<Tensor> {
        let (heads, width) = (self.shape.heads, self.shape.head_width());
        let normed = self.norm(x, "space.norm")?;
        // [C·T, heads, N, width]
        let by_tti = |name: &str| -> Result<Tensor> {
            let split = normed.matmul(self.var(name))?.reshape((c * t, n, heads, width))?;
            split.transpose(1, 2)?.contiguous()
        };
        let positive = |x: Tensor| x.relu()? + f64::from(MIN_FEATURE);
        let (query, key) = (positive(by_tti("space.query")?)?, positive(by_tti("space.key")?)?);
        let summary = key.t()?.contiguous()?.matmul(&by_tti("space.value")?)?;
        let weight_sum = query.broadcast_mul(&key.sum_keepdim(2)?)?.sum_keepdim(D::Minus1)?;
        // Every feature is at least `MIN_FEATURE`, so the divisor is above 0.
        let gathered = query.matmul(&summary)?.broadcast_div(&weight_sum)?;
        let gathered = gathered
            .transpose(1, 2)?
            .contiguous()?
            .reshape((c * t * n, heads * width))?;
        x + gathered.matmul(self.var("space.out"))?
    }

    /// Returns the values of the weight `name`.
    ///
    /// # Errors
    /// If the framework fails.
    ///
    /// # Panics
    /// If the shape has no tensor of this name.
    pub fn values(&self, name: &str) -> Result<Vec<f32>> {
        self.var(name).to_dtype(DType::F32)?.flatten_all()?.to_vec1()
    }
}
