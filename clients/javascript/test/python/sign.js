/** Sign a probe for tests/clients/javascript/test_service.py. */

import { signedProbe } from "../../dist/index.js";
import { bytes, input, output } from "./io.js";

const { bearer, subject, template, level } = await input();
output(await signedProbe(bearer, subject, bytes(template), { level: level ?? undefined }));
