"""Predictors over time: an action-conditioned transformer, block-causal masks, and an MLP.

Positions in time enter through rotary codes (RoPE, arXiv:2104.09864), which depend on differences alone: a
history that is still short predicts the same wherever it stands in the sequence.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models.attention import attention
from franka_wm.models.layers import zero_head
from franka_wm.models.vision import sincos


def block_causal_mask(frames: int, tokens: int = 1, device: torch.device | None = None) -> Tensor:
    """Who may attend to whom: all tokens of a frame to all of this and earlier frames.

    Args:
        frames: number of frames.
        tokens: number of tokens of each frame.

    Returns:
        (frames · tokens, frames · tokens) bool, True where the row may attend to the column.
    """
    time = torch.arange(frames, device=device).repeat_interleave(tokens)
    return time.unsqueeze(1) >= time.unsqueeze(0)


def hide_invalid(mask: Tensor, valid: Tensor, tokens: int = 1) -> Tensor:
    """A block-causal mask that also hides frames which never were.

    Args:
        mask: (L, L) bool, L = frames · tokens.
        valid: (N, frames), 1 (or True) where the frame is real.
        tokens: number of tokens of each frame.

    Returns:
        (N, 1, L, L) bool. Every token keeps itself, so that no row is empty (its softmax would be nan).
    """
    seen = (valid > 0.5).repeat_interleave(tokens, dim=1)[:, None, None, :]
    itself = torch.eye(mask.shape[0], dtype=torch.bool, device=mask.device)
    return (mask & seen) | itself


def rotary(x: Tensor, positions: Tensor) -> Tensor:
    """Rotate pairs of features of queries or keys (N, heads, L, D) by their positions (L,); D even."""
    half = x.shape[-1] // 2
    frequencies = 100.0 ** (-torch.arange(half, device=x.device, dtype=torch.float32) / half)
    angles = positions.to(torch.float32).unsqueeze(-1) * frequencies
    cos, sin = angles.cos().to(x.dtype), angles.sin().to(x.dtype)
    a, b = x[..., :half], x[..., half:]
    return torch.cat((a * cos - b * sin, a * sin + b * cos), dim=-1)


class CausalBlock(nn.Module):
    """Transformer block with masked attention; conditioned through AdaLN-zero if `condition` is given.

    AdaLN-zero (DiT, arXiv:2212.09748): the condition gives scale, shift and gate of both halves, and starts
    at zero, so that the block starts as the identity.

    Args:
        width: size of a token.
        heads, head_dim: heads of the attention and their size; `head_dim` even.
        hidden: width of the MLP.
        condition: size of the condition; without, a plain pre-norm block.
        dropout: after attention and inside the MLP, where `forward` is asked for it.
    """

    def __init__(
        self,
        *,
        width: int,
        heads: int,
        head_dim: int,
        hidden: int,
        condition: int | None = None,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.heads, self.dropout = heads, dropout
        affine = condition is None
        self.norm1 = nn.LayerNorm(width, eps=1e-6, elementwise_affine=affine)
        self.norm2 = nn.LayerNorm(width, eps=1e-6, elementwise_affine=affine)
        self.qkv, self.out = nn.Linear(width, 3 * heads * head_dim), nn.Linear(heads * head_dim, width)
        self.up, self.down = nn.Linear(width, hidden), nn.Linear(hidden, width)
        self.modulation = None if condition is None else nn.Linear(condition, 6 * width)

    def zero(self) -> None:
        """Start as the identity where conditioned."""
        if self.modulation is not None:
            nn.init.zeros_(self.modulation.weight)
            nn.init.zeros_(self.modulation.bias)

    def forward(
        self,
        x: Tensor,
        positions: Tensor,
        mask: Tensor,
        condition: Tensor | None = None,
        *,
        dropout: bool = False,
    ) -> Tensor:
        """(N, L, width), positions (L,), mask (L, L) or (N, 1, L, L), condition (N, L, C) -> (N, L, width)."""
        if self.modulation is None:
            x = x + self._drop(self._attend(self.norm1(x), positions, mask), dropout)
            return x + self._drop(self._mlp(self.norm2(x), dropout), dropout)
        assert condition is not None
        shift1, scale1, gate1, shift2, scale2, gate2 = self.modulation(F.silu(condition)).chunk(6, dim=-1)
        attended = self._attend(torch.addcmul(shift1, self.norm1(x), 1 + scale1), positions, mask)
        x = x + gate1 * self._drop(attended, dropout)
        fed = self._mlp(torch.addcmul(shift2, self.norm2(x), 1 + scale2), dropout)
        return x + gate2 * self._drop(fed, dropout)

    def _attend(self, x: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        q, k = rotary(q, positions), rotary(k, positions)
        return self.out(attention(q, k, v, mask).transpose(1, 2).flatten(-2))

    def _mlp(self, x: Tensor, dropout: bool) -> Tensor:
        return self.down(self._drop(F.gelu(self.up(x)), dropout))

    def _drop(self, x: Tensor, dropout: bool) -> Tensor:
        return F.dropout(x, self.dropout) if dropout and self.dropout else x


class CausalTransformer(nn.Module):
    """A stack of `CausalBlock`s and a last LayerNorm: (N, L, width) -> (N, L, width).

    Args: as for `CausalBlock`, and
        depth: number of blocks.

    Raises:
        ValueError: a size below 1, an odd `head_dim`, or a dropout outside [0, 1).
    """

    def __init__(
        self,
        *,
        width: int,
        depth: int,
        heads: int,
        head_dim: int,
        hidden: int,
        condition: int | None = None,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        sizes = {"width": width, "heads": heads, "head_dim": head_dim, "hidden": hidden}
        for name, value in {**sizes, "depth": depth}.items():
            if value < 1:
                raise ValueError(f"{name} of a transformer must be at least 1, got {value}")
        if head_dim % 2:
            raise ValueError(f"head_dim must be even (rotary codes turn pairs of features), got {head_dim}")
        if not 0.0 <= dropout < 1.0:
            raise ValueError(f"dropout must be in [0, 1), got {dropout}")
        blocks = [CausalBlock(**sizes, condition=condition, dropout=dropout) for _ in range(depth)]
        self.blocks = nn.ModuleList(blocks)
        self.norm = nn.LayerNorm(width, eps=1e-6)
        # Unit gain, as in DiT: with the usual 0.02, narrow transformers pass on next to nothing of an action.
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)
        for block in blocks:
            block.zero()

    def forward(
        self,
        x: Tensor,
        positions: Tensor,
        mask: Tensor,
        condition: Tensor | None = None,
        *,
        dropout: bool = False,
    ) -> Tensor:
        """See `CausalBlock.forward`."""
        for block in self.blocks:
            x = block(x, positions, mask, condition, dropout=dropout)
        return self.norm(x)


class MLPDynamics(nn.Module):
    """The next frame from a history and an action, by an MLP that predicts the change.

    (z (..., history_dim), last frame (..., frame_dim), action (..., action_dim)) -> (..., frame_dim).
    Starts as "nothing changes".

    Args:
        history_dim: size of z, see `franka_wm.models.history`.
        hidden: width of each hidden layer.
    """

    def __init__(self, *, history_dim: int, frame_dim: int, action_dim: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.network = zero_head(history_dim + action_dim, hidden, frame_dim)

    def forward(self, z: Tensor, frame: Tensor, action: Tensor) -> Tensor:
        return frame + self.network(torch.cat((z, action), dim=-1))


class TokenDynamics(nn.Module):
    """Block-causal transformer over [action, state, tokens] of several frames; predicts the frame after each.

    Every token attends to all tokens of its own and earlier frames. Predicts the change, and starts with none.

    Args:
        tokens, token_dim: of the images of one frame.
        state_dim: size of the state vector; 0: no state token.
        action_dim: size of an action.
        width, depth, heads, dropout: of the transformer.
    """

    place: Tensor

    def __init__(
        self,
        *,
        tokens: int,
        token_dim: int,
        state_dim: int,
        action_dim: int,
        width: int,
        depth: int,
        heads: int,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        if width % (2 * heads):
            raise ValueError(
                f"predictor_width must be a multiple of 2 · predictor_heads, got {width} and {heads}"
            )
        self.tokens, self.token_dim, self.state_dim = tokens, token_dim, state_dim
        self.feature_dim = tokens * token_dim
        self.per_frame = tokens + 1 + (1 if state_dim else 0)
        self.enter = nn.Linear(token_dim, width)
        self.enter_action = nn.Linear(action_dim, width)
        self.enter_state = nn.Linear(state_dim, width) if state_dim else None
        self.transformer = CausalTransformer(
            width=width, depth=depth, heads=heads, head_dim=width // heads, hidden=4 * width, dropout=dropout
        )
        self.leave = nn.Linear(width, token_dim)
        self.leave_state = nn.Linear(width, state_dim) if state_dim else None
        for layer in (self.leave, self.leave_state):
            if layer is not None:
                nn.init.zeros_(layer.weight)
                nn.init.zeros_(layer.bias)
        self.register_buffer("place", sincos(torch.arange(self.per_frame), width), persistent=False)

    def forward(
        self, frames: Tensor, actions: Tensor, valid: Tensor | None, *, dropout: bool = False
    ) -> Tensor:
        """Frames (N, K, F), the action taken at each (N, K, A) -> the frame after each (N, K, F).

        Args:
            valid: (N, K), 1 where the frame is real; None: all are.
        """
        count, steps = frames.shape[:2]
        features = frames[..., : self.feature_dim].unflatten(-1, (self.tokens, self.token_dim))
        parts = [self.enter_action(actions.to(frames.dtype)).unsqueeze(2)]
        if self.enter_state is not None:
            parts.append(self.enter_state(frames[..., self.feature_dim :]).unsqueeze(2))
        parts.append(self.enter(features))
        x = (torch.cat(parts, dim=2) + self.place).flatten(1, 2)
        mask = block_causal_mask(steps, self.per_frame, device=x.device)
        if valid is not None:
            mask = hide_invalid(mask, valid, self.per_frame)
        time = torch.arange(steps, device=x.device).repeat_interleave(self.per_frame)
        x = self.transformer(x, time, mask, dropout=dropout).view(count, steps, self.per_frame, -1)
        after = (features + self.leave(x[:, :, -self.tokens :])).flatten(-2)
        if self.leave_state is None:
            return after
        state = frames[..., self.feature_dim :] + self.leave_state(x[:, :, 1])
        return torch.cat((after, state), dim=-1)
