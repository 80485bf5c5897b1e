"""Stand-in until saccade.config exists."""

from dataclasses import dataclass

try:
    from saccade.errors import CheckpointError
except ImportError:

    class CheckpointError(ValueError):
        pass


try:
    from saccade.config import HeadConfig
except ImportError:

    @dataclass(frozen=True)
    class HeadConfig:
        width: int
        num_layers: int
        num_heads: int
        head_dim: int
        context_dim: int
        interleave_self_attention: bool
        vl_num_layers: int
        vl_num_heads: int
        vl_head_dim: int
        use_vlln: bool
        num_future_tokens: int
        action_horizon: int
        action_dim: int
        encoder_action_dim: int
        state_dim: int
        state_history: int
        hidden_dim: int
        num_embodiments: int
        num_timestep_buckets: int
        num_steps: int
        max_positions: int
        add_pos_embed: bool
        version: str

        @classmethod
        def from_dict(cls, whole):
            head = whole.get("action_head_cfg", whole)
            dit = head["diffusion_model_cfg"]
            use_vlln = head["use_vlln"]
            vl = head["vl_self_attention_cfg"] if use_vlln else {"num_layers": 0, "num_attention_heads": 1}
            return cls(
                width=head["input_embedding_dim"],
                num_layers=dit["num_layers"],
                num_heads=dit["num_attention_heads"],
                head_dim=dit["attention_head_dim"],
                context_dim=head["backbone_embedding_dim"],
                interleave_self_attention=dit["interleave_self_attention"],
                vl_num_layers=vl["num_layers"],
                vl_num_heads=vl["num_attention_heads"],
                vl_head_dim=vl.get("attention_head_dim", head["backbone_embedding_dim"]),
                use_vlln=use_vlln,
                num_future_tokens=head["num_target_vision_tokens"],
                action_horizon=head["action_horizon"],
                action_dim=head["action_dim"],
                encoder_action_dim=head["action_dim"],
                state_dim=head["max_state_dim"],
                state_history=1,
                hidden_dim=head["hidden_size"],
                num_embodiments=head.get("max_num_embodiments", 32),
                num_timestep_buckets=head["num_timestep_buckets"],
                num_steps=head["num_inference_timesteps"],
                max_positions=head.get("max_seq_len", 1024),
                add_pos_embed=head["add_pos_embed"],
                version="n1.5",
            )
