"""A layer as one program that runs without this package: ``torch.export`` and ONNX."""

__all__: list[str] = []
